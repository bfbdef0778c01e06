"use strict";
// The planned tap: drawn on the image, with buttons to make or skip it if it waits for
// confirmation.

class Planned {
  constructor() {
    this.tap = null;
    this.answerBy = 0;
    for (const [id, confirm] of [["planned-yes", true], ["planned-no", false]]) {
      $(id).addEventListener("click", () => {
        if (this.tap) request("confirm", { tap_id: this.tap.tap_id, confirm });
      });
    }
  }

  forget() {
    this.tap = null;
  }

  // The buttons refer to the tap whose description is shown. After a new tap is shown, they are
  // disabled for a moment.
  render(tap, drawing) {
    this.draw(drawing);
    const waiting = tap && tap.waiting ? tap : null, card = $("planned");
    const other = waiting && (!this.tap || this.tap.tap_id !== waiting.tap_id);
    this.tap = waiting;
    card.hidden = !waiting;
    if (!waiting) return;
    this.answerBy = performance.now() + 1000 * waiting.seconds_left;
    this.tick();
    if (!other) return;
    card.dataset.tap = waiting.tap_id;
    setText($("planned-answer"), "");
    setText($("planned-title"), `Make tap ${waiting.number}?`);
    setText($("planned-words"), this.words(waiting));
    // A click that was meant for the previous tap must not confirm this one.
    for (const id of ["planned-yes", "planned-no"]) {
      const button = $(id);
      button.disabled = true;
      setTimeout(() => { button.disabled = false; }, 400);
    }
  }

  words(tap) {
    const why = tap.reason ? ` Reason for this tap: ${tap.reason}.` : "";
    const effort = tap.expected ? ` Expected effort to the goal, including this tap: ${tap.expected}.` : "";
    const [distance, angle] = tap.remaining;
    const [x, y] = tap.to;
    return `The striker at ${tap.speed.toFixed(0)} mm/s moves the object by ${tap.distance.toFixed(1)} \u00b1 ${tap.deviation.toFixed(1)} mm `
      + `and turns it by ${signed(tap.turn)} \u00b1 ${tap.turn_deviation.toFixed(1)}\u00b0, to x ${signed(x)} mm, y ${signed(y)} mm. Then ${distance.toFixed(1)} mm and `
      + `${signed(angle)}\u00b0 remain to the goal.${effort}${why}`;
  }

  tick() {
    if (!this.tap) return;
    const left = Math.max(0, Math.ceil((this.answerBy - performance.now()) / 1000));
    setText($("planned-clock"), `Without an answer, the goal ends in ${left} s.`);
  }

  draw(drawing) {
    const group = $("planned-drawing");
    group.toggleAttribute("hidden", !drawing);
    if (!drawing) return;
    const set = (id, points) => $(`planned-${id}`).setAttribute("points", pointList(points));
    for (const id of ["ellipse", "outline", "way", "arrow"]) set(id, drawing[id].map(scaled));
    set("shade", drawing.arrow.map(scaled));
    const [from, to] = drawing.arrow.map(scaled), length = Math.hypot(to[0] - from[0], to[1] - from[1]) || 1;
    const [x, y] = [(to[0] - from[0]) / length, (to[1] - from[1]) / length];
    const head = [[0, 0], [-22, 9], [-22, -9]].map(([a, b]) => [to[0] + a * x - b * y, to[1] + a * y + b * x]);
    set("head", head);
  }
}
