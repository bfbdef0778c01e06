"use strict";
// The operator's page: shows the state that the node operator_page sends, and sends a person's
// commands to that node.

const SILENCE_MS = 3000;        // timeout for messages of the node; then the connection is lost
const ANSWER_MS = 6000;         // timeout for the response to a request
const STALE_S = 2;              // age above which an image is greyed out
const MODE_WORDS = {
  ready: "Ready", moving: "Moving", waiting: "Your turn", "not ready": "Not ready", fault: "Fault", stopped: "Stopped",
  lost: "Not connected",
};
const ANSWERS = {
  goal: "goal-answer", cancel: "goal-answer", stop: "attention-answer", clear: "attention-answer",
  press_button: "attention-answer", home: "attention-answer", confirm: "planned-answer",
  queue: "queue-answer", settings: "settings-answer", arrange: "arrange-answer", keep_run: "run-answer",
  jog: "jog-answer", park: "jog-answer", fire_at_nothing: "jog-answer",
};

let socket = null, connected = false, refusedFor = "", attempts = 0, retryAt = 0;
let lostAt = performance.now(), heardAt = 0, state = null, cell = null, picture = null;
let followed = "", asking = "", runs = [];
const CONFIRMED = {
  clear: {
    words: "Clear the stop and the faults? Arm and tapper may move again. Is the cause removed, and is everybody clear of the cell?",
    yes: "Yes, clear them",
  },
  home: {
    words: "Home the arm? It moves immediately, all the way to its end switches. Is its path free, and is everybody clear of the arm?",
    yes: "Yes, home the arm",
  },
};
const waiting = new Map();          // time of each request without a response so far

// ---- The connection

function takeToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    sessionStorage.setItem("token", given);
    history.replaceState(null, "", location.pathname);  // removed from the address bar and the history
  }
  return sessionStorage.getItem("token") || "";
}

function connect() {
  retryAt = 0;
  const url = new URL("live", location.href);
  url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
  url.hash = "";
  const made = new WebSocket(url);
  made.binaryType = "arraybuffer";
  socket = made;
  heardAt = performance.now();
  made.onopen = () => made.send(JSON.stringify({ do: "hello", token: takeToken() }));
  made.onmessage = (event) => {
    if (socket !== made) return;
    heardAt = performance.now();
    if (typeof event.data === "string") receive(JSON.parse(event.data));
    else showPicture(made, event.data);
  };
  made.onclose = (event) => { if (socket === made) lose(event.code, event.reason); };
}

function lose(code, reason) {
  if (connected) lostAt = heardAt;
  connected = false;
  socket = null;
  waiting.clear();
  for (const each of Ghost.all) each.forget();
  refusedFor = code >= 4000 ? reason : "";
  attempts += 1;
  const pause = code === 4401 ? Infinity : Math.min(5000, 400 * 2 ** Math.min(attempts, 5));
  retryAt = performance.now() + pause;
  $("token-form").hidden = code !== 4401;
  if (code === 4401) sessionStorage.removeItem("token");
  render();
}

function say(content) {
  if (!connected || socket.readyState !== WebSocket.OPEN) return false;
  socket.send(JSON.stringify(content));
  return true;
}

// `to` is the name in the response, if it differs from the name of the request.
function request(name, content = {}, to = name) {
  show(to, "", "");
  if (say({ do: name, ...content })) waiting.set(to, performance.now());
  else show(to, "not sent: there is no connection", "bad");
}

function receive(message) {
  if (message.type === "welcome") {
    cell = message;
    connected = true;
    attempts = 0;
    followed = "";
    planned.forget();
    if (state) state.placeable = false;  // the last state may be outdated
    const where = message.namespace === "/" ? "" : `${message.namespace} `;
    setText($("cell"), where + message.cell);
    document.title = where + message.cell;
    settings.welcome(message);
    arrangement.welcome(message);
    render();
  } else if (message.type === "state") {
    state = message;
    render();
  } else if (message.type === "ghost") {
    arrangement.marker(message.object || cell.object).answer(message);
  } else if (message.type === "preset") {
    waiting.delete("arrange");
    arrangement.take(message.goals);
  } else if (message.type === "runs") {
    runs = message.runs;
  } else if (message.type === "answer") {
    waiting.delete(message.to);
    show(message.to, message.text, message.ok ? "good" : "bad");
    if (message.to === "goal") setText($("goal-hint"), message.hint || "");
  }
}

function show(to, text, kind) {
  const place = $(ANSWERS[to] || "goal-answer");
  setText(place, text);
  place.className = "answer " + kind;
  if (place.id === "goal-answer") setText($("goal-hint"), "");
}

// ---- The image

async function showPicture(from, data) {
  const head = new DataView(data, 0, 20);
  const number = head.getUint32(0), stamp = head.getFloat64(4), age = head.getFloat64(12);
  try {
    const bitmap = await createImageBitmap(new Blob([data.slice(20)], { type: "image/jpeg" }));
    const canvas = $("picture");
    if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
      canvas.width = bitmap.width;
      canvas.height = bitmap.height;
      $("stage").style.setProperty("--aspect", bitmap.width / bitmap.height);
      Ghost.size(bitmap.height / bitmap.width);
    }
    canvas.getContext("2d").drawImage(bitmap, 0, 0);
    bitmap.close();
    picture = { age, at: performance.now() };
    canvas.dataset.number = number;
    canvas.dataset.delay = (Date.now() - 1000 * stamp).toFixed(1);  // ms, if both clocks agree
  } finally {
    if (socket === from) say({ do: "seen", number });
  }
}

function pictureAge() {
  return picture ? picture.age + (performance.now() - picture.at) / 1000 : Infinity;
}

function ageText(seconds) {
  if (seconds < 1) return "less than 1 s";
  if (seconds < 120) return `${Math.floor(seconds)} s`;
  return `${Math.floor(seconds / 60)} min`;
}

// The object that is being tapped, else the cell's own.
function shownObject() {
  const name = state.plan.busy && state.plan.object || cell.object, own = state.object;
  if (name === cell.object) return { ...own, name };
  const row = arrangement.seen(name);
  return row ? { ...row, visible: true, sentence: "", code: 0 } : { name, visible: false, sentence: "", code: 0 };
}

function renderPicture() {
  const age = pictureAge(), stale = age > STALE_S;
  document.body.classList.toggle("stale", stale);
  const seen = state && shownObject();
  let words = "";
  if (!connected) {
    words = picture ? `Connection lost. This image is ${ageText(age)} old.` : "";
  } else if (!picture) {
    words = state && performance.now() - lostAt > 2000
      ? "No image yet. " + (sentence(seen && seen.sentence) || "Is camera_pose active?") : "";
  } else if (stale) {
    words = `This image is ${ageText(age)} old. ` + (sentence(seen && seen.sentence) || "Check the camera and camera_pose.");
  }
  setText($("stage-words"), words);
  $("stage-words").hidden = !words;
  if (!connected || !seen) return;
  const parts = [];
  const objects = state.arrangement.objects, missing = objects.filter((each) => !each.pose).map((each) => each.name);
  if (objects.length && !state.plan.busy) {
    parts.push(`${objects.length - missing.length} of ${objects.length} objects seen`);
    if (missing.length) parts.push(`not seen: ${missing.join(", ")}`);
  } else if (seen.visible) {
    const [x, y, angle] = seen.pose;
    parts.push(`${seen.name} ${seen.at_rest ? "at rest" : "moving"} at x ${signed(x)} mm, y ${signed(y)} mm, ${signed(angle)}\u00b0`);
  }
  else if (!seen.code) parts.push(`the arm hides ${seen.name}`);
  if (seen.sentence && !words) parts.push(`${seen.sentence} (${seen.code})`);
  if (!stale) parts.push(`image ${age.toFixed(1)} s old`);
  const unknown = state ? state.arrangement.unknown : 0;
  if (unknown) parts.push(`the planner avoids ${counted(unknown, "object")} without an object file (red outline)`);
  setText($("picture-words"), parts.join(" \u00b7 "));
}

// ---- Everything else

function render() {
  document.body.classList.toggle("lost", !connected);
  const mode = connected && state ? state.mode : "lost";
  document.body.dataset.mode = mode;
  setText($("mode-word"), MODE_WORDS[mode]);
  setText($("mode-sentence"), connected && state ? state.sentence : "");
  if (cell) setText($("object"), arrangement.several ? state && state.plan.busy && state.plan.object || `${arrangement.names.length} objects` : cell.object);
  renderBanner();
  renderPicture();
  for (const id of ["send", "goal-x", "goal-y", "goal-angle", "confirm-yes"]) $(id).disabled = !connected;
  renderStop();
  renderEnabling(state && state.set_up, connected, state && state.arm);
  renderJog(state, connected);
  if (!state) {
    for (const id of ["cancel", "home-ghost"]) $(id).disabled = true;
    return;
  }
  planned.render(connected ? state.plan.planned : null, connected ? state.planned_drawing : null);
  settings.render(state, connected);
  if (connected) drafts.take(state.drafts);
  arrangement.render(state, connected);
  renderAttention(mode);
  renderGoal();
  renderTaps();
  renderNodes();
  renderLog();
  renderRuns(runs, cell ? cell.key : "", state.runs_hint, connected);
}

function renderStop() {
  const ready = connected || stop.served;
  $("stop").disabled = !ready;
  setText(document.querySelector(".stop-note"), ready ? (!state || state.arm ? "arm and tapper" : "all tappers") : "offline: use the wired stop");
}

const TITLES = { stopped: "The cell is stopped", fault: "The cell has a fault" };
const STEP_BUTTONS = { clear: "Clear the stop and faults\u2026", home: "Home the arm\u2026", press_button: "Press it (simulated)" };

function renderAttention(mode) {
  const steps = mode === "lost" ? [] : state.recovery, card = $("attention");
  const halted = mode in TITLES;
  if (mode !== "lost") {
    if (card.hidden !== !steps.length) setText($("attention-answer"), "");
    card.hidden = !steps.length;
    if (asking && !steps.some((step) => step.command === asking && step.state === "now")) ask("");
  }
  card.classList.toggle("mild", !halted);
  setText($("attention-title"), TITLES[mode] || "The arm is not homed");
  setText($("attention-words"), halted ? sentence(state.sentence) : "Its position is unknown, so it cannot make a tap.");
  setText($("attention-hint"), mode === "fault" ? state.hint : "");
  renderSteps(steps);
}

function renderSteps(steps) {
  const list = $("steps"), focused = document.activeElement && document.activeElement.dataset.command;
  const words = ({ text, state }) => (state === "done" ? "Done: " : "") + text;
  // A countdown changes only the words: a button stays where it is while it is clicked.
  if (isShown(list, steps.map(({ state, command }) => [state, command]), connected)) {
    steps.forEach((step, number) => setText(list.children[number].firstChild, words(step)));
    return;
  }
  list.replaceChildren(...steps.map((step) => {
    const { state, command } = step, row = create("li", { className: state }, create("span", {}, words(step)));
    if (state !== "now") return row;
    row.setAttribute("aria-current", "step");
    if (!command) return row;
    const button = create("button", {
      type: "button", id: "step-" + command.replace("_", "-"), className: "strong", disabled: !connected,
    }, STEP_BUTTONS[command]);
    button.dataset.command = command;
    button.addEventListener("click", () => command in CONFIRMED ? ask(command) : request(command));
    row.append(button);
    return row;
  }));
  const again = focused && list.querySelector(`[data-command="${focused}"]`);
  if (again) again.focus();
}

// Commands that may move the cell are confirmed in the card itself, because a dialog window would
// hide STOP.
function ask(what) {
  const before = asking;
  asking = what;
  $("confirm").hidden = !what;
  $("steps").hidden = Boolean(what);
  if (what) {
    setText($("confirm-words"), CONFIRMED[what].words);
    setText($("confirm-yes"), CONFIRMED[what].yes);
    $("confirm-no").focus();
  } else {
    const button = before && $("steps").querySelector(`[data-command="${before}"]`);
    if (button) button.focus();
  }
}

function renderBanner() {
  let words = "", clock = "";
  if (!connected && refusedFor) {
    words = $("token-form").hidden ? `Connection refused: ${refusedFor}.`
      : `This cell requires a token (${refusedFor}). The node operator_page printed the token when it started.`;
  } else if (!connected && attempts > 0) {
    const wait = Math.max(0, Math.ceil((retryAt - performance.now()) / 1000));
    words = "No connection to the cell, which may continue to move. To stop it, use its wired emergency stop.";
    if (state) clock = `The values shown are ${ageText((performance.now() - lostAt) / 1000)} old. `;
    clock += socket ? "Trying to connect\u2026" : `Trying again in ${wait} s.`;
  }
  setText($("banner-clock"), clock);
  setText($("banner-words"), words);
  $("banner").hidden = !words;
}

function renderGoal() {
  const plan = state.plan;
  $("cancel").disabled = !connected || !plan.busy;
  $("home-ghost").disabled = !connected || !state.placeable || !ghost.touched || !poseOf(chosen);
  setText($("send"), state.arrangement.active ? "Replace the arrangement by this goal" : plan.busy ? "Replace the goal" : "Send goal");
  const blocked = connected ? state.blocked : "";
  $("send").disabled = !connected || Boolean(blocked);
  setText($("goal-blocked"), blocked);
  $("to-go").hidden = !plan.goal;
  if (plan.goal) {
    // While the arm hides the object, the last known distance stays; a goal that ended has no stale one.
    const key = JSON.stringify([plan.object, plan.goal]);
    if (plan.distance !== null || !plan.busy || toGo.key !== key) toGo = { key, distance: plan.distance, rotation: plan.rotation };
    setText($("to-go-distance"), toGo.distance === null ? "\u2013" : toGo.distance.toFixed(toGo.distance < 100 ? 1 : 0) + " mm");
    setText($("to-go-rotation"), toGo.distance === null ? "\u2013" : signed(toGo.rotation, 1, "\u00b0"));
    setText($("to-go-taps"), String(plan.taps));
    setText($("to-go-taps-unit"), plan.taps === 1 ? "tap" : "taps");
    $("to-go").classList.toggle("reached", plan.state === "reached");
  }
  let words = "No goal.";
  if (plan.goal) {
    const [x, y, angle] = plan.goal;
    const within = plan.tolerance[0] ? `, within ${plan.tolerance[0]} mm and ${plan.tolerance[1]}\u00b0` : "";
    const whose = arrangement.several && plan.object ? `Goal of ${plan.object}:` : "Goal";
    words = `${whose} x ${signed(x)} mm, y ${signed(y)} mm, ${signed(angle)}\u00b0${within}: ${plan.state}.`;
  }
  const why = plan.code ? `${plan.sentence} (${plan.code})` : "";
  if (why && why !== $("goal-answer").textContent) words += ` ${why}`;
  setText($("goal-words"), words);
  follow(plan.busy && (plan.object || cell.object) === chosen ? plan.goal : poseOf(chosen));
}

// The pose at which an object is seen; null if it is not seen.
function poseOf(name) {
  if (name === cell.object && state.object.visible) return state.object.pose;
  const seen = arrangement.seen(name);
  return seen ? seen.pose : null;
}

// The goal card belongs to the chosen object.
function choose(name) {
  if (name === chosen) return;
  chosen = name;
  ghost = arrangement.marker(name);
  followed = "";
  $("goal-object").value = name;
  setText($("goal-trouble"), "");
  if (ghost.shape && ghost.touched) posed(name, ghost.shape, false);
  if (state) follow(poseOf(name));
  arrangement.refresh();
}

function follow(pose) {
  // Until a person has chosen a goal, the outline is shown at the current goal or, without a goal,
  // at the object.
  if (!connected || !pose || !pose.every(Number.isFinite) || !state.placeable || ghost.touched || ghost.hold || editing()) return;
  const key = pose.map((n) => n.toFixed(1)).join();
  if (key === followed) return;
  followed = key;
  ghost.place(pose[0], pose[1], pose[2]);
}

function triple(values) {
  const [x, y, angle] = values;
  return x === null ? ["not seen"] : [`${signed(x)}, ${signed(y)}`, `${signed(angle)}\u00b0`];
}

function renderTaps() {
  const taps = state.taps, body = $("taps").tBodies[0];
  $("taps").hidden = $("taps-note").hidden = !taps.length;
  const last = taps.length ? taps[taps.length - 1].object : state.plan.object, one = taps.every((tap) => tap.object === last);
  setText($("taps-title"), arrangement.several && last && one ? `Taps of ${last}` : "Taps");
  renderPlot(taps.filter((tap) => tap.object === last), state.plan.tolerance && state.plan.tolerance[0], arrangement.several ? last : "");
  $("no-taps").hidden = Boolean(taps.length);
  if (isShown(body, taps, state.plan.tolerance)) return;
  const [mm, degrees] = state.plan.tolerance || [0, 0];
  body.replaceChildren(...taps.map((tap) => {
    const row = create("tr");
    const cell = (name, lines, kind = "", note = "") => {
      const made = row.insertCell();
      made.dataset.name = name;
      made.className = kind;
      made.append(...lines.map((text) => create("span", {}, text)));
      if (note) made.append(create("small", {}, note));
    };
    const speed = tap.speed === null ? "" : `${tap.speed.toFixed(0)} mm/s, `;
    const outcome = tap.outcome === "fired" ? "" : `${tap.outcome}, `;
    cell("Tap", [String(tap.number)], "", one ? "" : tap.object);
    cell("Commanded", triple(tap.commanded), "", `${outcome}${speed}${tap.method}`);
    cell("Predicted", triple(tap.predicted));
    cell("Measured", triple(tap.measured));
    const [distance, angle] = tap.remaining;
    const inside = distance !== null && distance <= mm && Math.abs(angle) <= degrees;
    cell("Remaining", distance === null ? ["not seen"] : [`${distance.toFixed(2)} mm`, `${signed(angle, 2)}\u00b0`],
      "remaining" + (inside ? " inside" : ""));
    return row;
  }));
}

function renderNodes() {
  if (isShown($("nodes"), state.nodes)) return;
  const words = { ok: "ok", warn: "warning", error: "error" };
  const part = (className, text) => create("span", { className }, text);
  $("nodes").replaceChildren(...state.nodes.map((node) => create(
    "li", { className: node.level }, part("dot", ""), part("name", node.name),
    part("life", `${node.life}, ${words[node.level] || "unknown"}`),
    ...(node.sentence && node.sentence !== "ok" ? [part("said", node.sentence)] : []))));
}

function renderLog() {
  const kind = $("log-kind").value, words = $("log-words").value.trim().toLowerCase();
  const lines = state.log.filter((line) => (!kind || line.kind === kind) && line.text.toLowerCase().includes(words));
  $("no-log").hidden = Boolean(lines.length);
  if (isShown($("log"), lines)) return;
  $("log").replaceChildren(...lines.reverse().map(({ time, text, kind }) => create(
    "li", {}, create("time", {}, new Date(1000 * time).toLocaleTimeString([], { hour12: false })),
    create("span", { className: kind }, text))));
}

// ---- Commands of the operator

const FIELDS = { x: $("goal-x"), y: $("goal-y"), angle: $("goal-angle") };
const FIELD_NAMES = { x: "x", y: "y", angle: "The angle" };

function editing() {
  return Object.values(FIELDS).includes(document.activeElement);
}

function readField(name) {
  const typed = FIELDS[name].value.trim().replace("\u2212", "-").replace(",", ".");
  const value = /^[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?$/i.test(typed) ? Number(typed) : NaN;
  const good = Number.isFinite(value);
  FIELDS[name].setAttribute("aria-invalid", String(!good));
  const unit = name === "angle" ? "degrees" : "mm";
  const trouble = good ? "" : `${FIELD_NAMES[name]} is ${typed ? `'${typed}'` : "empty"}: type a number in ${unit}, such as 12.5.`;
  return { value, trouble };
}

function objectOf() {
  return arrangement.several ? { object: chosen } : {};
}

function readGoal() {
  const read = { x: readField("x"), y: readField("y"), angle: readField("angle") };
  const tolerance = settings.tolerance();
  const trouble = Object.values(read).map((field) => field.trouble).find(Boolean) || tolerance.trouble || "";
  setText($("goal-trouble"), trouble);
  return trouble ? null : { x: read.x.value, y: read.y.value, angle: read.angle.value, ...tolerance.value };
}

let chosen = "", toGo = {};         // the object of the goal card, and its last known distance
const planned = new Planned();
const settings = new Settings();
const arrangement = new Arrangement();
const drafts = new Drafts(() => arrangement.rows.values());
const stop = new Stop(() => say({ do: "stop" }), (text, kind) => show("stop", text, kind), () => renderStop());
const ownGhost = new Ghost($("ghost"), "", say, (pose, typed) => posed(cell.object, pose, typed));
let ghost = ownGhost;
Ghost.taken = (each) => choose(each.object || cell.object);
Ghost.changed = () => drafts.changed();
$("goal-object").addEventListener("change", () => choose($("goal-object").value));

function posed(name, pose, typed) {
  arrangement.moved(name, pose);
  if (name !== chosen) return;
  if (pose.trouble) {
    if (ghost.touched && !typed) setText($("goal-trouble"), pose.trouble);
    return;
  }
  if (ghost.hold) show("goal", "", "");
  if (!typed) {
    for (const name of ["x", "y", "angle"]) {
      FIELDS[name].value = pose[name].toFixed(1);
      FIELDS[name].setAttribute("aria-invalid", "false");
    }
  }
  setText($("goal-trouble"), pose.refusal ? `The planner will refuse this goal: ${pose.refusal}` : "");
}

for (const [name, field] of Object.entries(FIELDS)) {
  field.addEventListener("input", () => {
    ghost.touched = true;
    show("goal", "", "");
    const goal = readGoal();
    if (goal) ghost.place(goal.x, goal.y, goal.angle, true);
    drafts.changed();
  });
  field.addEventListener("keydown", (event) => {
    const step = { ArrowUp: 1, ArrowDown: -1 }[event.key];
    const { value, trouble } = readField(name);
    if (!step || trouble) return;
    event.preventDefault();
    field.value = (value + step * (event.shiftKey ? 10 : 1)).toFixed(1);
    field.dispatchEvent(new Event("input"));
  });
}

$("goal-form").addEventListener("submit", (event) => {
  event.preventDefault();
  const goal = readGoal();
  if (!goal) {
    document.querySelector('#goal-form [aria-invalid="true"]').focus();
    return;
  }
  if ($("send").disabled) return;
  ghost.touched = true;
  document.activeElement.blur();
  setText($("goal-trouble"), "");
  request("goal", { ...goal, ...objectOf() });
});
$("stop").addEventListener("click", () => stop.press());
$("cancel").addEventListener("click", () => request("cancel"));
$("home-ghost").addEventListener("click", () => {
  ghost.touched = false;
  followed = "";
  follow(poseOf(chosen));
  drafts.changed();
  arrangement.refresh();
});
$("run-filter").addEventListener("input", () => { if (state) renderRuns(runs, cell.key, state.runs_hint, connected); });
for (const id of ["log-kind", "log-words"]) $(id).addEventListener("input", () => { if (state) renderLog(); });
$("confirm-no").addEventListener("click", () => ask(""));
$("confirm-yes").addEventListener("click", () => {
  const what = asking;
  ask("");
  request(what);
});
$("confirm").addEventListener("keydown", (event) => { if (event.key === "Escape") ask(""); });
$("token-form").addEventListener("submit", (event) => {
  event.preventDefault();
  sessionStorage.setItem("token", $("token").value.trim());
  $("token").value = "";
  connect();
});

// ---- The clock

setInterval(() => {
  const now = performance.now();
  if (socket && now - heardAt > SILENCE_MS) {
    const silent = socket;
    lose(1006, "");
    silent.close();
  } else if (!socket && now >= retryAt) {
    connect();
  }
  for (const [name, since] of waiting) {
    if (now - since < ANSWER_MS) continue;
    waiting.delete(name);
    show(name, "no answer so far; check the list of nodes", "bad");
  }
  renderBanner();
  renderPicture();
  planned.tick();
}, 250);
addEventListener("online", () => { if (!socket && retryAt < Infinity) connect(); });
document.addEventListener("visibilitychange", () => {
  if (!document.hidden && !socket && retryAt < Infinity) connect();
});
connect();
