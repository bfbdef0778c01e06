"use strict";
// Plot of the remaining error after each tap, and table of the recorded runs.

const SVG = "http://www.w3.org/2000/svg";

function drawn(name, attributes, text = "") {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  return made;
}

// Plot the distance to the goal before the first tap of an object and after each tap, on a logarithmic
// scale. In an arrangement, the first tap of an object need not be tap 1.
// The area within the tolerance is filled.
function renderPlot(taps, tolerance, object) {
  const plot = $("plot");
  const first = taps.length ? taps[0].number - 1 : 0;
  const points = taps.length && taps[0].before[0] !== null ? [[first, taps[0].before[0]]] : [];
  for (const tap of taps) if (tap.remaining[0] !== null) points.push([tap.number, tap.remaining[0]]);
  if (points.length < 2 || !tolerance) {
    plot.setAttribute("hidden", "");
    return;
  }
  plot.removeAttribute("hidden");
  const left = 56, right = 392, top = 10, bottom = 106;
  const least = Math.log10(Math.max(0.01, Math.min(tolerance / 3, ...points.map((p) => p[1]))));
  const most = Math.log10(Math.max(2 * tolerance, ...points.map((p) => p[1])));
  const last = Math.max(points[points.length - 1][0], first + 3);
  const x = (tap) => left + 8 + (right - left - 16) * (tap - first) / (last - first);
  const y = (mm) => bottom - (bottom - top) * (Math.log10(Math.max(mm, 10 ** least)) - least) / (most - least);
  const parts = [drawn("rect", { class: "inside", x: left, width: right - left, y: y(tolerance), height: bottom - y(tolerance) })];
  for (let power = Math.ceil(least); power <= most; power += 1) {
    parts.push(drawn("line", { class: "grid", x1: left, x2: right, y1: y(10 ** power), y2: y(10 ** power) }));
    parts.push(drawn("text", { x: left - 5, y: y(10 ** power) + 4, "text-anchor": "end" }, `${+(10 ** power).toFixed(2)} mm`));
  }
  const step = Math.ceil((last - first) / 10);
  for (let tap = first; tap <= last; tap += step) parts.push(drawn("text", { x: x(tap), y: bottom + 14, "text-anchor": "middle" }, tap > first ? `${tap}` : "start"));
  parts.push(drawn("text", { x: left + 4, y: y(tolerance) + 13 }, `${object ? `${object}: ` : ""}tolerance ${tolerance} mm`));
  parts.push(drawn("polyline", { points: points.map(([tap, mm]) => `${x(tap).toFixed(1)},${y(mm).toFixed(1)}`).join(" ") }));
  for (const [tap, mm] of points) parts.push(drawn("circle", { cx: x(tap), cy: y(mm), r: 3.5 }));
  plot.replaceChildren(...parts);
  plot.setAttribute("aria-label", `Distance ${object ? `of ${object} ` : ""}to the goal: `
    + points.map(([tap, mm]) => `${tap > first ? `after tap ${tap}` : "at the start"} ${mm.toFixed(1)} mm`).join(", "));
}

function runLink(key, run, file, text) {
  const href = `runs/${key}/${encodeURIComponent(run.name)}/${file}`;
  const link = create("a", file === "report.html" ? { href, target: "_blank", rel: "noopener" } : { href }, text);
  link.setAttribute("aria-label", `${text} of ${run.name}`);
  return link;
}

function whenOf(run) {
  return run.began === null ? run.name : new Date(1000 * run.began).toLocaleString([], {
    month: "2-digit", day: "2-digit", hour: "2-digit", minute: "2-digit", hour12: false });
}

const chosenRuns = new Set();

// The link that compares the chosen runs; their order is that of the list.
function renderComparison(runs, key, connected) {
  const names = runs.map((run) => run.name).filter((name) => chosenRuns.has(name));
  const link = $("compare");
  link.hidden = !connected || names.length < 2;
  link.href = `runs/${key}/compare.html?${new URLSearchParams(names.map((name) => ["run", name]))}`;
  setText(link, `Compare ${names.length} runs`);
}

function renderRuns(runs, key, hint, connected) {
  const last = runs.find((run) => run.outcome !== "refused");
  setText($("run-words"), hint || (last ? `Last run: ${last.name}, ${last.outcome}.` : "No run has been recorded yet."));
  const report = $("last-report"), archive = $("download");
  report.hidden = !connected || !last || !last.report;
  archive.hidden = !connected || !last;
  if (last) {
    report.href = runLink(key, last, "report.html", "").href;
    archive.href = runLink(key, last, "run.zip", "").href;
  }
  renderComparison(runs, key, connected);
  const body = $("runs").tBodies[0];
  $("runs-scroll").hidden = !runs.length;
  const words = $("run-filter").value.trim().toLowerCase().split(/\s+/);
  const found = runs.filter((run) => words.every((word) => `${whenOf(run)} ${run.name} ${run.outcome} ${run.error}`.toLowerCase().includes(word)));
  if (isShown(body, key, found)) return;
  body.replaceChildren(...found.map((run) => {
    const row = create("tr", { className: run.outcome === "refused" ? "refused" : "", title: run.name });
    const goal = run.objects > 1 ? `${run.objects} objects` : run.goal ? `${run.goal.map((n) => n === null ? "?" : n.toFixed(0)).join(", ")}\u00b0` : "?";
    const residual = run.residual && run.residual[0] !== null
      ? `${run.residual[0].toFixed(2)} mm, ${run.residual[1].toFixed(1)}\u00b0` : "";
    const box = create("input", { type: "checkbox", checked: chosenRuns.has(run.name) });
    box.setAttribute("aria-label", `compare ${run.name}`);
    box.addEventListener("change", () => {
      chosenRuns[box.checked ? "add" : "delete"](run.name);
      renderComparison(runs, key, connected);
    });
    row.insertCell().append(box);
    for (const text of [whenOf(run), goal, run.outcome, run.taps === null ? "" : String(run.taps), residual]) row.insertCell().textContent = text;
    row.cells[3].title = run.error;
    const files = row.insertCell();
    if (run.report) files.append(runLink(key, run, "report.html", "report"), " ");
    files.append(runLink(key, run, "run.zip", "zip"));
    const star = create("button", { type: "button", className: "star", title: run.kept
      ? "This run is never deleted. Press to allow its deletion." : "Keep this run: it is never deleted." }, run.kept ? "\u2605" : "\u2606");
    star.setAttribute("aria-label", `keep ${run.name}`);
    star.setAttribute("aria-pressed", String(run.kept));
    star.addEventListener("click", () => request("keep_run", { run: run.name, keep: !run.kept }));
    row.insertCell().append(star);
    return row;
  }));
}
