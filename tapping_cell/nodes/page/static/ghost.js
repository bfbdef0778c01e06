"use strict";
// A ghost is the outline of an object's goal on the image. It follows the pointer immediately, but only
// approximately. The node computes the exact pose with the camera's model, one request at a time.

class Ghost {
  constructor(group, object, ask, onPose) {
    this.group = group;
    this.object = object;      // name of the object; empty for the cell's own object
    this.ask = ask;            // sends a request to the node; returns false without a connection
    this.onPose = onPose;      // called with every response: pose in mm and degrees, refusal, typed
    this.shape = null;         // the node's last response
    this.touched = false;      // the operator has moved the ghost, so it no longer follows the goal
    this.number = 0;
    this.waiting = false;
    this.next = null;
    this.hold = null;
    this.parts = {};
    for (const part of group.querySelectorAll("[data-part]")) this.parts[part.dataset.part] = part;
    this.overlay = $("overlay");
    Ghost.all.add(this);
    for (const [name, kind] of [["outline", "move"], ["handle", "turn"]]) {
      const part = this.parts[name];
      part.addEventListener("pointerdown", (event) => this.grab(event, kind));
      part.addEventListener("pointermove", (event) => this.drag(event));
      for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
        part.addEventListener(end, () => this.release());
      }
      part.addEventListener("keydown", (event) => this.key(event));
    }
    this.size();
  }

  // Requests. While a request is pending, only the latest new request is kept.

  question(content, typed = false) {
    this.next = { content, typed };
    this.pump();
  }

  pump() {
    if (this.waiting || !this.next) return;
    const { content, typed } = this.next;
    this.next = null;
    this.number += 1;
    this.typed = typed;
    this.waiting = this.ask({ ...content, ...(this.object && { object: this.object }), number: this.number });
  }

  place(x, y, angle, typed = false) {
    this.question({ do: "place", x, y, angle }, typed);
  }

  answer(message) {
    if (message.number !== this.number) return;
    this.waiting = false;
    const typed = this.typed;
    if (message.trouble) {
      this.onPose({ trouble: message.trouble }, typed);
    } else {
      // A key press during the request goes on from the pose of the press, not from this older one.
      const next = this.next?.content;
      this.shape = next?.do === "place" ? { ...message, x: next.x, y: next.y, angle: next.angle } : message;
      this.group.removeAttribute("hidden");
      this.group.classList.toggle("touched", this.touched);
      this.group.classList.toggle("refused", Boolean(message.refusal));
      this.draw();
      this.onPose(message, typed);
    }
    this.pump();
  }

  forget() {  // the connection was lost, so a pending request will get no response
    this.waiting = false;
    this.next = null;
    this.release();
  }

  // Dragging

  at(event) {
    const box = this.overlay.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  }

  grab(event, kind) {
    if (!this.shape || event.button > 0) return;
    event.preventDefault();
    Ghost.taken(this);
    event.currentTarget.setPointerCapture(event.pointerId);
    event.currentTarget.focus({ preventScroll: true });
    const from = kind === "move" ? this.shape.centre : this.shape.handle;
    const [u, v] = this.at(event);
    this.hold = { kind, du: from[0] - u, dv: from[1] - v, u: from[0], v: from[1] };
    this.group.classList.add("held");
  }

  drag(event) {
    const hold = this.hold;
    if (!hold) return;
    const [u, v] = this.at(event);
    hold.u = Math.min(1, Math.max(0, u + hold.du));
    hold.v = Math.min(1, Math.max(0, v + hold.dv));
    this.touched = true;
    this.draw();
    const { x, y, angle } = this.shape;
    this.question(hold.kind === "move"
      ? { do: "move", u: hold.u, v: hold.v, angle }
      : { do: "turn", x, y, u: hold.u, v: hold.v });
  }

  release() {
    if (this.hold && this.touched) Ghost.changed();
    this.hold = null;
    this.group.classList.remove("held");
    if (this.shape) this.draw();
  }

  key(event) {
    if (!this.shape) return;
    const step = event.shiftKey ? 10 : 1;
    const turns = { PageUp: step, PageDown: -step };
    const ways = { ArrowRight: 0, ArrowUp: 90, ArrowLeft: 180, ArrowDown: 270 };
    let { x, y, angle } = this.shape;
    if (event.key in turns) {
      angle += turns[event.key];
    } else if (event.key in ways) {
      const way = (ways[event.key] + this.shape.right) * Math.PI / 180;
      x += step * Math.round(Math.cos(way));
      y += step * Math.round(Math.sin(way));
    } else {
      return;
    }
    event.preventDefault();
    Ghost.taken(this);
    this.touched = true;
    Ghost.changed();
    this.place(x, y, angle);
    this.shape = { ...this.shape, x, y, angle };  // the next key press starts from here
  }

  // Drawing

  size() {
    const unit = 1000 / (this.overlay.clientWidth || 1000);
    this.set("handle", { r: 24 * unit });
    this.set("knob", { r: 10 * unit, "stroke-width": 2 * unit });
    this.set("centre", { r: 4 * unit });
  }

  draw() {
    const { outline, centre, handle } = this.shape;
    const c = scaled(centre), h = scaled(handle);
    const [x, y] = this.hold ? scaled([this.hold.u, this.hold.v]) : c;
    let moved = (p) => p;
    if (this.hold && this.hold.kind === "move") {
      moved = ([px, py]) => [px + x - c[0], py + y - c[1]];
    } else if (this.hold) {
      const turn = Math.atan2(y - c[1], x - c[0]) - Math.atan2(h[1] - c[1], h[0] - c[0]);
      const cos = Math.cos(turn), sin = Math.sin(turn);
      moved = ([px, py]) => [
        c[0] + cos * (px - c[0]) - sin * (py - c[1]),
        c[1] + sin * (px - c[0]) + cos * (py - c[1]),
      ];
    }
    const points = pointList(outline.map((p) => moved(scaled(p))));
    const [cx, cy] = moved(c), [hx, hy] = moved(h);
    for (const name of ["outline", "shade"]) this.set(name, { points });
    for (const name of ["arm", "arm-shade"]) this.set(name, { x1: cx, y1: cy, x2: hx, y2: hy });
    this.box = boxOf(points.split(" ").map((p) => p.split(",").map(Number)));
    this.knob = [hx, hy];
    this.set("centre", { cx, cy });
    for (const name of ["knob", "handle"]) this.set(name, { cx: hx, cy: hy });
  }

  set(name, attributes) {
    for (const [key, value] of Object.entries(attributes)) this.parts[name].setAttribute(key, value);
  }
}

Ghost.all = new Set();
Ghost.taken = () => {};    // called with the ghost that the operator takes hold of
Ghost.changed = () => {};  // called when the operator has placed a ghost
Ghost.aspect = 0.8;  // height of the image divided by its width
Ghost.size = (aspect = Ghost.aspect) => {
  Ghost.aspect = aspect;
  $("overlay").setAttribute("viewBox", `0 0 1000 ${1000 * aspect}`);
  for (const each of Ghost.all) {
    each.size();
    if (each.shape) each.draw();
  }
};
new ResizeObserver(() => Ghost.size()).observe($("overlay"));
