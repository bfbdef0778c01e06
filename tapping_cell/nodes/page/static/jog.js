"use strict";
// Manual steps of the arm in set-up mode, while the enabling key is held.

const JOG_AXES = ["x", "y", "z", "yaw", "shoulder", "elbow", "quill", "tool"];
const JOG_KEYS = {
  ArrowRight: ["x", 1], ArrowLeft: ["x", -1], ArrowUp: ["y", 1], ArrowDown: ["y", -1], PageUp: ["z", 1], PageDown: ["z", -1],
};

function jog(axis, sign) {
  request("jog", { axis, step: sign * Number($("jog-size").value) });
}

function renderJog(state, connected) {
  $("jog").hidden = !state || !state.arm;
  if (!state || !state.arm) return;
  const blocked = connected ? state.set_up.jog_blocked : "There is no connection.";
  const moves = state.arm.state === "moving" || state.arm.state === "withdrawing";
  for (const button of $("jog").querySelectorAll("button")) button.disabled = Boolean(blocked) || moves;
  $("jog-home").disabled = !connected || !state.set_up.enabled || !["idle", "not homed"].includes(state.arm.state);
  const tip = state.arm.tip;
  setText($("jog-tip"), tip ? `Tip: x ${signed(tip[0])} mm, y ${signed(tip[1])} mm, z ${signed(tip[2])} mm, yaw ${signed(tip[3])}\u00b0` : "");
  setText($("jog-blocked"), blocked || "");
}

for (const axis of JOG_AXES) {
  const sign = (value, text) => {
    const button = create("button", { type: "button" }, text);
    button.setAttribute("aria-label", `${axis} ${value < 0 ? "minus" : "plus"}`);
    button.addEventListener("click", () => jog(axis, value));
    return button;
  };
  $("jog-steps").append(create("div", {}, sign(-1, "\u2212"), create("span", {}, axis), sign(1, "+")));
}
for (const button of $("jog").querySelectorAll("button")) {
  // The space bar holds the key while the mouse clicks a step: the focus stays at the key.
  button.addEventListener("mousedown", (event) => event.preventDefault());
  // Browsers send no click for a second finger while the first one holds the key.
  button.addEventListener("touchend", (event) => {
    if (!event.touches.length) return;
    event.preventDefault();
    const { clientX, clientY } = event.changedTouches[0];
    if (document.elementFromPoint(clientX, clientY) === button) button.click();
  });
}
$("jog-home").addEventListener("click", () => request("home"));
$("jog-park").addEventListener("click", () => request("park", {}, "jog"));
$("jog-fire").addEventListener("click", () => request("fire_at_nothing", {}, "jog"));
$("enable").addEventListener("keydown", (event) => {
  const step = JOG_KEYS[event.key];
  if (!step || event.repeat) return;
  event.preventDefault();
  jog(...step);
});
