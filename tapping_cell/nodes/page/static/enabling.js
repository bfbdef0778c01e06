"use strict";
// The enabling key of set-up mode sends a heartbeat ten times per second while it is held. The
// heartbeats end if the pointer or key is released, the pointer slides away, the page loses the focus,
// the connection is lost or the page hangs. While the pointer holds it, the keyboard may operate the
// rest of the page.

const ENABLE_PERIOD_MS = 100;
const HOLDING_KEYS = [" ", "Enter"];
const SLIDE_PX = 48;             // from the place of the press: the page may move under the finger
let enableTimer = 0;
let heldByKeyboard = false;
let pressedAt = [0, 0];

function holdEnabling(event) {
  if (event.type === "keydown") {
    if (!HOLDING_KEYS.includes(event.key)) return;
    event.preventDefault();
    if (event.repeat) return;
  }
  if (enableTimer || event.button > 0) return;
  heldByKeyboard = event.type === "keydown";
  pressedAt = [event.clientX, event.clientY];
  if (event.pointerId !== undefined) $("enable").setPointerCapture(event.pointerId);
  say({ do: "enable" });
  enableTimer = setInterval(() => { if (!say({ do: "enable" })) releaseEnabling(); }, ENABLE_PERIOD_MS);
  $("enable").setAttribute("aria-pressed", "true");
}

function releaseEnabling() {
  if (!enableTimer) return;
  clearInterval(enableTimer);
  enableTimer = 0;
  say({ do: "disable" });
  $("enable").setAttribute("aria-pressed", "false");
}

function renderEnabling(setUp, connected, arm) {
  $("set-up").hidden = !setUp || !setUp.on;
  $("enable").disabled = !connected;
  if (!connected || !setUp || !setUp.on) releaseEnabling();
  const works = arm && ["homing", "moving", "in position", "withdrawing"].includes(arm.state);
  setText($("enabled"), !setUp || !setUp.enabled ? "Not enabled: nothing moves."
    : works ? `Enabled: the arm is ${arm.state}, and a release stops it.`
    : !arm || ["idle", "not homed"].includes(arm.state) ? "Enabled: the arm may move." : "Held, but the arm is not ready: nothing moves.");
}

for (const name of ["pointerdown", "keydown"]) $("enable").addEventListener(name, holdEnabling);
for (const name of ["pointerup", "pointercancel", "lostpointercapture", "contextmenu"]) {
  $("enable").addEventListener(name, releaseEnabling);
}
$("enable").addEventListener("pointermove", ({ clientX, clientY }) => {
  if (!heldByKeyboard && Math.hypot(clientX - pressedAt[0], clientY - pressedAt[1]) > SLIDE_PX) releaseEnabling();
});
// Other keys step the arm while the key is held.
$("enable").addEventListener("keyup", (event) => { if (HOLDING_KEYS.includes(event.key)) releaseEnabling(); });
// Once the focus has moved, the release of a key would not be received here any more.
$("enable").addEventListener("blur", () => { if (heldByKeyboard) releaseEnabling(); });
window.addEventListener("blur", releaseEnabling);
window.addEventListener("pagehide", releaseEnabling);
document.addEventListener("visibilitychange", () => { if (document.hidden) releaseEnabling(); });
