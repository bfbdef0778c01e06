"use strict";
// Arrangement of several objects: an outline on the image for each object, presets, and progress.

class Arrangement {
  constructor() {
    this.names = [];
    this.rows = new Map();     // by object name: the table row and the goal of the object
    $("arrange").addEventListener("click", () => this.send());
    for (const button of document.querySelectorAll("[data-preset]")) {
      button.addEventListener("click", () => this.ask(button.dataset.preset));
    }
  }

  // The cell's own object uses the outline of the goal card; each further object uses a copy of it.
  welcome(message) {
    $("arrange-card").hidden = !message.objects.length;
    if (message.objects.join("\n") === this.names.join("\n")) {
      for (const row of this.rows.values()) this.revive(row);
      return;
    }
    for (const row of this.rows.values()) {
      if (row.ghost !== ghost) {
        Ghost.all.delete(row.ghost);
        row.ghost.group.remove();
      }
    }
    this.names = message.objects;
    this.rows = new Map(this.names.map((name) => [name, this.row(name, name === message.object)]));
    document.querySelector("#arrange-table tbody").replaceChildren(...[...this.rows.values()].map((row) => row.element));
  }

  row(name, own) {
    const element = create("tr"), box = create("input", { type: "checkbox" });
    element.insertCell().append(create("label", {}, box, name));
    const goal = element.insertCell(), progress = element.insertCell();
    const made = { name, element, box, goal, progress, ghost: own ? ghost : this.copy(name), pose: null };
    made.ghost.parts.label.textContent = name;
    box.addEventListener("change", () => this.tick(made));
    return made;
  }

  copy(name) {
    const group = $("ghost").cloneNode(true);
    for (const part of [group, ...group.querySelectorAll("[id]")]) part.removeAttribute("id");
    group.setAttribute("hidden", "");
    group.setAttribute("class", "ghost");
    group.setAttribute("aria-label", `Outline of the goal of ${name}`);
    for (const part of group.querySelectorAll("[aria-label]")) {
      part.setAttribute("aria-label", part.getAttribute("aria-label").replace("the goal", `the goal of ${name}`));
    }
    $("overlay").append(group);
    return new Ghost(group, name, say, (pose) => this.moved(name, pose));
  }

  marker(name) {
    return this.rows.get(name).ghost;
  }

  revive(row) {  // repeat requests that got no answer because the connection was lost
    if (row.ghost !== ghost && row.box.checked && row.pose) row.ghost.place(row.pose.x, row.pose.y, row.pose.angle);
  }

  // A further object has an outline only while it has a goal. It is first drawn at the object.
  tick(row) {
    const seen = state && state.arrangement.objects.find((each) => each.name === row.name);
    if (row.box.checked && row.ghost !== ghost && seen && seen.pose) {
      row.ghost.touched = true;
      row.ghost.place(...seen.pose);
    }
    this.hide();
    this.describe(row);
    this.enable();
  }

  hide() {
    for (const row of this.rows.values()) {
      if (row.ghost !== ghost && !row.box.checked) row.ghost.group.setAttribute("hidden", "");
    }
  }

  take(goals) {
    for (const row of this.rows.values()) row.box.checked = false;
    for (const [name, x, y, angle] of goals) {
      const row = this.rows.get(name);
      row.box.checked = row.ghost.touched = true;
      row.ghost.place(x, y, angle);
    }
    this.hide();
    for (const row of this.rows.values()) this.describe(row);
    this.enable();
  }

  moved(name, pose) {
    const row = this.rows.get(name);
    if (!row) return;
    row.trouble = pose.trouble || (pose.refusal ? `The planner will refuse this: ${pose.refusal}` : "");
    if (!pose.trouble) row.pose = pose;
    if (!row.box.checked) this.hide();
    this.describe(row);
  }

  describe(row) {
    const has = row.box.checked, part = (tag, text) => create(tag, {}, text);
    row.element.classList.toggle("refused", has && Boolean(row.trouble));
    const texts = has && row.pose ? [part("span", `${signed(row.pose.x)}, ${signed(row.pose.y)} mm`), part("span", signed(row.pose.angle, 1, "\u00b0"))]
      : [part("span", has ? "not placed yet" : "none")];
    if (has && row.trouble) texts.push(part("small", row.trouble));
    row.goal.replaceChildren(...texts);
  }

  ticked() {
    return [...this.rows.values()].filter((row) => row.box.checked);
  }

  ask(preset) {
    const chosen = this.ticked().length > 1 ? this.ticked() : [...this.rows.values()];
    request("preset", { preset, objects: chosen.map((row) => row.name) }, "arrange");
  }

  send() {
    const tolerance = settings.tolerance(), goals = this.ticked().filter((row) => row.pose);
    if (tolerance.trouble) {
      show("arrange", tolerance.trouble, "bad");
      return;
    }
    request("arrange", {
      goals: goals.map(({ name, pose }) => ({ object: name, x: pose.x, y: pose.y, angle: pose.angle })),
      in_order: $("in-order").checked, ...tolerance.value,
    });
  }

  enable() {
    const free = connected && state && state.placeable;
    $("arrange").disabled = !free || Boolean(state.blocked) || !this.ticked().some((row) => row.pose);
    for (const button of document.querySelectorAll("[data-preset]")) button.disabled = !free;
    for (const row of this.rows.values()) row.box.disabled = !free;
  }

  render(state, connected) {
    if (!this.names.length) return;
    const { progress, active, taps, objects } = state.arrangement;
    const told = Object.values(progress), reached = told.filter((one) => one.state === "reached").length;
    setText($("arrange-words"), !told.length ? ""
      : `${reached} of ${told.length} objects ${active ? "reached so far" : "reached"}, ${counted(taps, "tap")}.`);
    for (const row of this.rows.values()) {
      const one = progress[row.name], seen = objects.find((each) => each.name === row.name);
      if (isShown(row.element, one, seen && Boolean(seen.pose), connected)) continue;
      row.element.classList.toggle("reached", Boolean(one) && one.state === "reached");
      row.element.classList.toggle("active", Boolean(one) && active && ["being tapped", "making way"].includes(one.state));
      const words = one ? one.state : seen && seen.pose ? "" : "not seen";
      const numbers = one && one.distance !== null
        ? `${one.distance.toFixed(one.distance < 10 ? 2 : 0)} mm, ${signed(one.rotation)}\u00b0, ${counted(one.taps, "tap")}` : "";
      row.progress.replaceChildren(create("span", {}, words), create("small", {}, numbers));
    }
    this.enable();
  }
}
