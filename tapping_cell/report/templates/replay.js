// The player of a run. It moves the parts of the drawing to the recorded poses.
const replay = document.querySelector("#replay");
if (replay) {
  const data = JSON.parse(document.querySelector("#replay-data").textContent);
  const part = (name) => replay.querySelector(name);
  const play = part("[name=play]"), bar = part("[name=time]"), speed = part("[name=speed]"), words = part("output"), photo = part("img");
  const tip = part("[data-tip]"), drawings = [...replay.querySelectorAll("[data-tap]")];
  const photos = [...document.querySelectorAll("img[data-at]")].filter((each) => each !== photo)
    .map((each) => [Number(each.dataset.at), each.src]).sort((a, b) => a[0] - b[0]);
  let now = data.end, stopAt = data.end, last = null;

  function pose(track, time) {
    let low = 0, high = track.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (track[middle][0] <= time) low = middle; else high = middle;
    }
    const a = track[low], b = track[high], share = high === low ? 0 : Math.min(1, Math.max(0, (time - a[0]) / (b[0] - a[0])));
    return [1, 2, 3].map((n) => a[n] + share * (b[n] - a[n]));
  }

  function place(element, track) {
    const [x, y, angle] = pose(track, now);
    element.setAttribute("transform", `translate(${x} ${-y}) rotate(${-angle})`);
  }

  // The tap that the time belongs to: from its approach to the next tap's.
  const lead = (tap) => Math.max(0, tap.fired - 0.6);
  const present = () => data.taps.filter((tap) => lead(tap) <= now).pop();

  function draw() {
    for (const each of data.objects) place(part(`[data-object="${each.number}"]`), each.track);
    if (data.tip.length) place(tip, data.tip);
    const tap = present();
    for (const each of drawings) each.toggleAttribute("hidden", !tap || Number(each.dataset.tap) !== tap.number);
    bar.value = now;
    const whose = tap && data.objects.length > 1 ? `, ${tap.object}` : "";
    words.textContent = `${now.toFixed(2)} s of ${data.end.toFixed(1)} s${tap ? `, tap ${tap.number} of ${data.taps.length}${whose}` : ""}`;
    const shown = photos.filter(([at]) => at <= now + 0.05).pop() || photos[0];
    if (shown && photo.src !== shown[1]) photo.src = shown[1];
  }

  function rate() {
    if (speed.value !== "slow") return Number(speed.value);
    return data.taps.some((tap) => tap.fired - 0.1 <= now && now <= Math.min(tap.rest, tap.fired + 1)) ? 0.1 : 1;
  }

  function step(at) {
    if (last === null) return;
    now = Math.min(stopAt, now + rate() * (at - last) / 1000);
    last = now < stopAt ? at : null;
    if (last === null) play.textContent = "Play";
    draw();
    if (last !== null) requestAnimationFrame(step);
  }

  function start(from, to) {
    now = from;
    stopAt = to;
    play.textContent = "Pause";
    if (last === null) requestAnimationFrame((at) => { last = at; step(at); });
    else last = performance.now();
  }

  play.addEventListener("click", () => {
    if (last === null) start(now >= data.end ? 0 : now, data.end);
    else { last = null; play.textContent = "Play"; }
  });
  bar.max = data.end;
  bar.addEventListener("input", () => { now = Number(bar.value); stopAt = data.end; draw(); });
  part(".taps").append(...data.taps.map((tap) => {
    const button = document.createElement("button");
    button.textContent = `Tap ${tap.number}`;
    button.addEventListener("click", () => start(lead(tap), Math.min(data.end, tap.rest + 0.3)));
    return button;
  }));
  photo.hidden = !photos.length;
  part(".controls").hidden = false;
  draw();
}
