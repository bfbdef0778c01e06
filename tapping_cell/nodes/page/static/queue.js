"use strict";
// Queue of goals, named goals, and settings that may be changed while the cell runs.

const CHOICE_PATIENCE_MS = 2000;  // time for which a choice is shown although the planner does not report it

class Settings {
  constructor() {
    this.asked = null;   // new value of the check box, until the planner reports the same value
    this.chosen = null;  // likewise the new planning method
    this.on("ask", "change", (box) => {
      this.asked = { value: box.checked, at: performance.now() };
      request("set_ask", { ask: box.checked }, "settings");
    });
    this.on("planner", "change", (list) => {
      this.chosen = { value: list.value, at: performance.now() };
      request("set_planner", { planner: list.value }, "settings");
    });
    this.on("queue-run", "click", () => request("run_queue", {}, "queue"));
    this.on("queue-hold", "click", () => request("hold_queue", {}, "queue"));
    this.on("enqueue", "click", () => {
      const goal = readGoal();
      if (goal) request("queue_goal", { ...goal, ...objectOf() }, "queue");
    });
    this.on("keep", "click", () => {
      const goal = readGoal(), name = $("new-name");
      if (!name.value.trim()) {
        show("goal", "Type a name for this goal first.", "bad");
        name.focus();
      } else if (goal) {
        request("name_goal", { name: name.value.trim(), x: goal.x, y: goal.y, angle: goal.angle }, "queue");
        name.value = "";
      }
    });
    this.on("named", "change", (list) => {
      const chosen = list.selectedOptions[0];
      $("forget").disabled = !list.value;
      if (!list.value) return;
      const [x, y, angle] = JSON.parse(chosen.dataset.pose);
      ghost.touched = true;
      ghost.place(x, y, angle);
      drafts.changed();
    });
    this.on("forget", "click", () => request("forget_goal", { name: $("named").value }, "queue"));
    for (const id of ["tolerance-position", "tolerance-angle"]) this.on(id, "input", () => readGoal());
  }

  on(id, kind, act) {
    const element = $(id);
    element.addEventListener(kind, () => act(element));
  }

  welcome(message) {
    const list = $("planner"), kept = list.value;
    list.replaceChildren(...message.planners.map((name) => new Option(
      name === message.planner ? `${name} (this cell's default)` : name, name)));
    list.value = kept;  // the planner's present method follows with the state
    $("tolerance-position").placeholder = `${message.tolerance[0]}`;
    $("tolerance-angle").placeholder = `${message.tolerance[1]}`;
    setText($("settings-answer"), "");
  }

  // Empty fields select the cell's tolerance.
  tolerance() {
    const value = {};
    let trouble = "";
    for (const [id, name, unit] of [["tolerance-position", "position_tolerance", "mm"], ["tolerance-angle", "angle_tolerance", "degrees"]]) {
      const field = $(id), typed = field.value.trim().replace(",", ".");
      const good = !typed || (/^(\d+\.?\d*|\.\d+)$/.test(typed) && Number(typed) > 0);
      field.setAttribute("aria-invalid", String(!good));
      if (!good) {
        trouble = trouble || `The tolerance is '${typed}': type a number of ${unit} above 0, or leave the field empty for the cell's tolerance.`;
        $("more").open = true;
      } else if (typed) {
        value[name] = Number(typed);
      }
    }
    return { value, trouble };
  }

  // Returns the choice while it is recent and the planner reports another value, otherwise null.
  pending(choice, reported) {
    return choice && performance.now() - choice.at < CHOICE_PATIENCE_MS && choice.value !== reported ? choice : null;
  }

  render(state, connected) {
    this.asked = this.pending(this.asked, state.plan.ask);
    if (!this.asked) $("ask").checked = state.plan.ask;
    // An unknown method (null) leaves the list without a selection.
    this.chosen = this.pending(this.chosen, state.planner);
    const list = $("planner"), method = state.planner || "";
    if (!this.chosen && list.value !== method) list.value = method;
    for (const id of ["ask", "planner", "enqueue", "keep"]) $(id).disabled = !connected;
    this.renderQueue(state.queue, connected);
    this.renderNames(state.named);
  }

  renderQueue(queue, connected) {
    const count = queue.rows.length, run = $("queue-run"), hold = $("queue-hold");
    run.hidden = !count || queue.running;
    hold.hidden = !queue.running;
    run.disabled = !connected || Boolean(state.blocked);
    hold.disabled = !connected;
    const words = count ? `${count} ${count === 1 ? "goal is waiting" : "goals are waiting"}. ${queue.running ? "The next goal follows when the current goal is reached." : queue.held}`
      : queue.running ? "The last goal of the queue is active." : "No goal is waiting.";
    setText($("queue-words"), words);
    if (isShown($("queue"), queue.rows, connected)) return;
    $("queue").replaceChildren(...queue.rows.map(([number, x, y, angle, object]) => {
      const button = create("button", { type: "button", disabled: !connected }, "Remove");
      button.setAttribute("aria-label", `Remove the goal x ${x} mm, y ${y} mm, ${angle} degrees from the queue`);
      button.addEventListener("click", () => request("unqueue", { number }, "queue"));
      return create("li", {}, create("span", {}, `${object ? `${object}: ` : ""}${signed(x)}, ${signed(y)} mm, ${signed(angle)}\u00b0`), button);
    }));
  }

  renderNames(named) {
    const list = $("named"), kept = list.value;
    if (isShown(list, named)) return;
    list.replaceChildren(new Option("choose", ""), ...named.map(([name, ...pose]) => {
      const option = new Option(name, name);
      option.dataset.pose = JSON.stringify(pose);
      return option;
    }));
    list.value = named.some(([name]) => name === kept) ? kept : "";
    $("forget").disabled = !list.value;
  }
}
