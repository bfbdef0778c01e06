"use strict";
// The enabling key of set-up mode sends a heartbeat ten times per second while it is held. The
// heartbeats end if the pointer or key is released, the page loses the focus, the connection is lost
// or the page hangs. While the pointer holds it, the keyboard may operate the rest of the page.

const ENABLE_PERIOD_MS = 100;
let enableTimer = 0;
let heldByKeyboard = false;

function holdEnabling(event) {
  if (event.type === "keydown") {
    if (event.key !== " " && event.key !== "Enter") return;
    event.preventDefault();
    if (event.repeat) return;
  }
  if (enableTimer || event.button > 0) return;
  heldByKeyboard = event.type === "keydown";
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

function renderEnabling(setUp, connected) {
  $("set-up").hidden = !setUp || !setUp.on;
  $("enable").disabled = !connected;
  if (!connected || !setUp || !setUp.on) releaseEnabling();
  setText($("enabled"), setUp && setUp.enabled ? "Enabled: the arm may move." : "Not enabled: nothing moves.");
}

for (const name of ["pointerdown", "keydown"]) $("enable").addEventListener(name, holdEnabling);
for (const name of ["pointerup", "pointercancel", "lostpointercapture", "keyup", "contextmenu"]) {
  $("enable").addEventListener(name, releaseEnabling);
}
// Once the focus has moved, the release of a key would not be received here any more.
$("enable").addEventListener("blur", () => { if (heldByKeyboard) releaseEnabling(); });
window.addEventListener("blur", releaseEnabling);
window.addEventListener("pagehide", releaseEnabling);
document.addEventListener("visibilitychange", () => { if (document.hidden) releaseEnabling(); });
