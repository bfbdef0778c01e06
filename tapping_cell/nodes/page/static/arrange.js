"use strict";
// Arrangement of several objects: an outline on the image for each object, presets, and progress.

class Arrangement {
  constructor() {
    this.names = [];
    this.rows = new Map();     // by object name: the table row and the goal of the object
    this.several = false;
    this.marks = new ObjectMarks((name) => choose(name));
    $("arrange").addEventListener("click", () => this.send());
    for (const button of document.querySelectorAll("[data-preset]")) {
      button.addEventListener("click", () => this.ask(button.dataset.preset));
    }
  }

  // The cell's own object uses the outline in the page; each further object uses a copy of it.
  welcome(message) {
    this.several = message.objects.length > 0;
    $("arrange-card").hidden = $("goal-object-row").hidden = !this.several;
    const names = this.several ? message.objects : [message.object];
    if (names.join("\n") === this.names.join("\n")) {
      for (const row of this.rows.values()) this.revive(row);
      return;
    }
    for (const row of this.rows.values()) {
      if (row.ghost !== ownGhost) {
        Ghost.all.delete(row.ghost);
        row.ghost.group.remove();
      }
    }
    this.names = names;
    this.rows = new Map(this.names.map((name) => [name, this.row(name, name === message.object)]));
    document.querySelector("#arrange-table tbody").replaceChildren(...[...this.rows.values()].map((row) => row.element));
    $("goal-object").replaceChildren(...names.map((name) => new Option(name, name)));
    choose(message.object);
  }

  row(name, own) {
    const element = create("tr"), box = create("input", { type: "checkbox" });
    element.insertCell().append(create("label", {}, box, name));
    const goal = element.insertCell(), progress = element.insertCell();
    const made = { name, element, box, goal, progress, ghost: own ? ownGhost : this.copy(name), pose: null };
    made.ghost.parts.label.textContent = this.several ? name : "";
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
    return new Ghost(group, name, say, (pose, typed) => posed(name, pose, typed));
  }

  marker(name) {
    return this.rows.get(name).ghost;
  }

  revive(row) {  // repeat requests that got no answer because the connection was lost
    if (row.ghost.touched && row.pose) row.ghost.place(row.pose.x, row.pose.y, row.pose.angle);
  }

  seen(name) {
    return state && state.arrangement.objects.find((each) => each.name === name && each.pose);
  }

  // An object without a goal has an outline only while it is chosen. A goal is first drawn at the object.
  tick(row) {
    row.ghost.touched = row.box.checked;
    choose(row.name);
    const seen = this.seen(row.name);
    if (row.box.checked && seen) row.ghost.place(...seen.pose);
    drafts.changed();
    this.refresh();
  }

  refresh() {
    for (const row of this.rows.values()) {
      row.box.checked = row.ghost.touched;
      if (!row.ghost.touched && row.name !== chosen) row.ghost.group.setAttribute("hidden", "");
      row.ghost.group.classList.toggle("touched", row.ghost.touched);
      this.describe(row);
    }
    this.enable();
    this.label();
  }

  take(goals) {
    const given = new Map(goals.map(([name, ...pose]) => [name, pose]));
    for (const row of this.rows.values()) {
      row.ghost.touched = given.has(row.name);
      if (row.ghost.touched) row.ghost.place(...given.get(row.name));
    }
    drafts.changed();
    this.refresh();
  }

  // Name objects and goals in the image. An object at its goal is named once.
  label() {
    if (!this.several) return;
    const items = [], fixed = [];
    for (const mark of this.marks.marks.values()) items.push(mark);
    for (const { name, ghost: { group, box, knob, parts, touched } } of this.rows.values()) {
      if (!box || group.hasAttribute("hidden")) continue;
      fixed.push([knob[0] - 20, knob[1] - 20, knob[0] + 20, knob[1] + 20]);
      const mark = this.marks.marks.get(name), off = (a, b) => Math.hypot(a[0] + a[2] - b[0] - b[2], a[1] + a[3] - b[1] - b[3]) / 2;
      const named = touched && !(mark && off(mark.box, box) < 12);
      parts.label.toggleAttribute("hidden", !named);
      if (named) items.push({ label: parts.label, box });
    }
    placeLabels(items, fixed);
  }

  moved(name, pose) {
    const row = this.rows.get(name);
    if (!row) return;
    row.trouble = pose.trouble || (pose.refusal ? `The planner will refuse this: ${pose.refusal}` : "");
    if (!pose.trouble) row.pose = pose;
    row.box.checked = row.ghost.touched;
    if (!row.ghost.touched && name !== chosen) row.ghost.group.setAttribute("hidden", "");
    this.describe(row);
    this.label();
  }

  describe(row) {
    const has = row.ghost.touched, part = (tag, text) => create(tag, {}, text);
    const refused = has && Boolean(row.trouble);
    row.element.classList.toggle("refused", refused);
    row.goal.colSpan = refused ? 2 : 1;  // the reason is long
    row.progress.hidden = refused;
    const texts = has && row.pose ? [part("span", `${signed(row.pose.x)}, ${signed(row.pose.y)}`), part("span", signed(row.pose.angle, 1, "\u00b0"))]
      : [part("span", has ? "not placed yet" : "none")];
    if (refused) texts.push(part("small", row.trouble));
    row.goal.replaceChildren(...texts);
  }

  ticked() {
    return [...this.rows.values()].filter((row) => row.ghost.touched);
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
    if (!this.several) return;
    const { progress, active, taps, objects } = state.arrangement;
    this.marks.render(connected ? objects : [], state.plan.busy ? state.plan.object : "");
    this.label();
    setText($("arrange"), active ? "Replace the arrangement" : "Send the arrangement");
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
