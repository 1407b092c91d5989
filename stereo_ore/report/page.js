"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const at = id => document.getElementById(id);
const PALETTE = ["#e6550d", "#3182bd", "#31a354", "#756bb1", "#d6a000", "#c51b8a", "#17a2b8", "#8c6d31", "#e7298a", "#66a61e"];
const PLOT = { displaylogo: false, responsive: true, displayModeBar: false };
const PLOT_3D = { ...PLOT, displayModeBar: "hover", modeBarButtonsToRemove: ["hoverClosest3d"] };
const STRIKE_LENGTH_M = 0.25;

// --- small helpers

function make(tag, text = "", className = "") {
  const element = document.createElement(tag);
  element.textContent = text;
  if (className) element.className = className;
  return element;
}

const fixed = (value, digits, scale = 1) => value === null || value === undefined ? "" : (scale * value).toFixed(digits);
const vector = values => values ? values.map(value => value.toFixed(3)).join("  ") : "";
const plural = (count, word) => `${count} ${word}${count === 1 ? "" : "s"}`;
const layout = more => ({
  margin: { l: 50, r: 10, t: 10, b: 40 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
  font: { family: "system-ui, sans-serif", size: 12 },
  modebar: { bgcolor: "rgba(255,255,255,.7)", color: "#99a", activecolor: "#333" }, ...more,
});

// A column: [heading, value for sorting, text to show (default: the value), "text" for left alignment].
function sortable(table, columns, rows, onRow) {
  const head = make("thead"), body = make("tbody"), line = head.appendChild(make("tr"));
  let order = rows.map((row, place) => place), sorted = null, falling = false;
  const show = () => body.replaceChildren(...order.map(place => tableRow(columns, rows[place], place, onRow)));
  columns.forEach(([heading, value, , kind], number) => {
    const cell = line.appendChild(make("th", "", kind || ""));
    const button = cell.appendChild(make("button", heading));
    button.addEventListener("click", () => {
      falling = sorted === number ? !falling : false;
      sorted = number;
      order.sort((a, b) => compare(value(rows[a]), value(rows[b]), falling) || a - b);
      for (const other of line.children) other.removeAttribute("aria-sort");
      cell.setAttribute("aria-sort", falling ? "descending" : "ascending");
      show();
    });
  });
  show();
  table.replaceChildren(head, body);
}

function compare(a, b, falling) {
  const missing = value => value === null || value === undefined || value === "";
  if (missing(a) || missing(b)) return missing(a) - missing(b);  // what is missing comes last either way
  const result = typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b), "en", { numeric: true });
  return falling ? -result : result;
}

function tableRow(columns, row, place, onRow) {
  const line = make("tr");
  line.dataset.place = place;
  for (const [, value, text, kind] of columns) line.append(make("td", (text || value)(row) ?? "", kind || ""));
  if (onRow) line.addEventListener("click", () => onRow(row, place));
  return line;
}

function bars(table, entries) {
  const top = Math.max(...entries.map(([, value]) => value), 1e-9);
  table.replaceChildren(...entries.map(([name, value, text]) => {
    const line = make("tr"), bar = make("div", "", "bar");
    bar.style.width = `${100 * value / top}%`;
    line.append(make("td", name, "text"), make("td", text), make("td"));
    line.lastChild.append(bar);
    return line;
  }));
}

// --- one frame

function decode(text, Kind) {
  const bytes = Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
  return new Kind(bytes.buffer);
}

function points(packed) {
  const xyz = decode(packed.xyz_mm, Int16Array), grey = decode(packed.grey, Uint8Array), ore = decode(packed.ore, Uint16Array);
  const empty = () => ({ x: [], y: [], z: [], colour: [], id: [] });
  const rest = empty(), ores = empty();
  for (let i = 0; i < packed.count; i++) {
    const part = ore[i] ? ores : rest;
    part.x.push(xyz[3 * i] / 1000);
    part.y.push(xyz[3 * i + 1] / 1000);
    part.z.push(xyz[3 * i + 2] / 1000);
    part.colour.push(ore[i] ? ore[i] % PALETTE.length : grey[i]);
    part.id.push(ore[i]);
  }
  return { rest, ores };
}

function cloudTraces(detail) {
  const { rest, ores } = points(detail.points);
  const steps = PALETTE.flatMap((colour, i) => [[i / PALETTE.length, colour], [(i + 1) / PALETTE.length, colour]]);
  const marks = part => ({ type: "scatter3d", mode: "markers", x: part.x, y: part.y, z: part.z });
  const greys = { size: 1.6, color: rest.colour, cmin: 0, cmax: 255, colorscale: [[0, "#222"], [1, "#eee"]] };
  const colours = { size: 2, color: ores.colour, cmin: -0.5, cmax: PALETTE.length - 0.5, colorscale: steps };
  return [
    { ...marks(rest), name: "screen and rest", marker: greys, hoverinfo: "skip" },
    { ...marks(ores), name: "ore", marker: colours, customdata: ores.id, hovertemplate: "ore %{customdata}<extra></extra>" },
    ...(detail.grizzly ? [screenTrace(detail.grizzly, rest)] : []),
  ];
}

const add = (a, b, factor = 1) => a.map((value, i) => value + factor * b[i]);
const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = a => a.map(value => value / Math.hypot(...a));

function planeAxes(normal) {
  const down = unit(add([0, 1, 0], normal, -normal[1]));  // image rows, laid into the plane
  return [cross(down, normal), down];
}

function screenTrace(grizzly, rest) {
  const axes = planeAxes(grizzly.normal), base = grizzly.normal.map(value => value * grizzly.offset_m);
  const range = axes.map(axis => {
    const along = rest.x.map((x, i) => dot(axis, [x, rest.y[i], rest.z[i]])).sort((a, b) => a - b);
    return [along[Math.floor(0.02 * along.length)] ?? -1, along[Math.floor(0.98 * along.length)] ?? 1];
  });
  const corners = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([i, j]) => add(add(base, axes[0], range[0][i] - dot(axes[0], base)), axes[1], range[1][j] - dot(axes[1], base)));
  const axis = number => corners.map(corner => corner[number]);
  return { type: "mesh3d", name: "bar tops", showlegend: true, x: axis(0), y: axis(1), z: axis(2), i: [0, 0], j: [1, 2], k: [2, 3], opacity: 0.25, color: "#4477aa", hoverinfo: "skip" };
}

function lineTrace(name, segments, colour, width, more = {}) {
  const axis = number => segments.flatMap(([from, to]) => [from[number], to[number], null]);
  return { type: "scatter3d", mode: "lines", name, x: axis(0), y: axis(1), z: axis(2), line: { color: colour, width }, hoverinfo: "skip", ...more };
}

function boxEdges(ore) {
  const { centre, axes } = ore.box.camera, half = ore.box.extent_m.map(length => length / 2);
  const corner = bits => axes.reduce((point, axis, i) => add(point, axis, bits & (1 << i) ? half[i] : -half[i]), centre);
  const edges = [];
  for (let a = 0; a < 8; a++) for (let i = 0; i < 3; i++) if (!(a & (1 << i))) edges.push([corner(a), corner(a | (1 << i))]);
  return edges;
}

function oreTraces(detail) {
  const solids = detail.ores.filter(ore => ore.box), struck = detail.ores.filter(ore => ore.strike);
  const colours = [["oversize", true, "#d62728"], ["passes", false, "#2ca02c"], ["size unknown", null, "#e0a000"]];
  const traces = colours.map(([name, oversize, colour]) => lineTrace(`solid: ${name}`, solids.filter(ore => ore.oversize === oversize).flatMap(boxEdges), colour, 3));
  const centred = solids.filter(ore => ore.centre);
  traces.push(pointTrace("centre of gravity", centred.map(ore => ore.centre.camera), centred.map(oreText), { symbol: "cross", size: 4, color: "#00a5c8" }));
  const tips = struck.map(ore => ore.strike.point.camera);
  const tails = struck.map((ore, i) => add(tips[i], ore.strike.direction.camera, -STRIKE_LENGTH_M));
  traces.push(lineTrace("strike", tips.map((tip, i) => [tails[i], tip]), "#111", 6));
  traces.push(pointTrace("strike point", tips, struck.map(oreText), { symbol: "diamond", size: 4, color: struck.map(ore => ore.id === detail.targets[0] ? "#ff00c8" : "#111") }));
  return traces.filter(trace => trace.x.length);
}

function pointTrace(name, places, text, marker) {
  const axis = number => places.map(place => place[number]);
  return { type: "scatter3d", mode: "markers", name, x: axis(0), y: axis(1), z: axis(2), text, hovertemplate: "%{text}<extra></extra>", marker };
}

function oreText(ore) {
  const size = ore.size_m ? ore.size_m.map(length => (1000 * length).toFixed(0)).join(" × ") + " mm" : "size unknown";
  const place = ore.centre && (ore.centre.arm ? `centre, arm: ${vector(ore.centre.arm)} m` : `centre, camera: ${vector(ore.centre.camera)} m`);
  return [`ore ${ore.id}`, size, place].filter(Boolean).join("<br>");
}

// The 3-D view takes longest, seconds without a graphics card: the rest of the page is there before it.
let drawing = 0;
function drawCloudSoon(detail) {
  const turn = ++drawing;
  document.body.dataset.cloud = "drawing";
  at("cloud-caption").textContent = "Drawing the 3-D view …";
  requestAnimationFrame(() => setTimeout(() => {
    if (turn !== drawing) return;
    drawCloud(detail);
    document.body.dataset.cloud = "drawn";
  }));
}

function drawCloud(detail) {
  if (!detail.points) {
    Plotly.purge("cloud");
    at("cloud").replaceChildren();
    at("cloud-caption").textContent = "This frame has no cloud.";
    return;
  }
  const up = detail.grizzly ? detail.grizzly.normal : [0, 0, -1], back = planeAxes(up)[1];
  const eye = add(up.map(value => 1.4 * value), back, 1.3), axis = text => ({ title: { text }, showspikes: false });
  const xyz = vectorOf => ({ x: vectorOf[0], y: vectorOf[1], z: vectorOf[2] });
  const scene = { aspectmode: "data", camera: { up: xyz(up), eye: xyz(eye) }, xaxis: axis("x [m]"), yaxis: axis("y [m]"), zaxis: axis("z [m]") };
  Plotly.react("cloud", [...cloudTraces(detail), ...oreTraces(detail)], layout({ margin: { l: 0, r: 0, t: 0, b: 0 }, scene, legend: { x: 0, y: 1, itemsizing: "constant", bgcolor: "rgba(255,255,255,.7)" } }), PLOT_3D);
  at("cloud-caption").textContent = `${detail.points.count.toLocaleString("en")} of ${detail.points.of.toLocaleString("en")} kept voxels, camera frame. Drag to turn, click the legend to hide.`;
}

function drawScores(scores) {
  const wide = scores.edges.slice(1).map((edge, i) => edge - scores.edges[i]), middle = wide.map((width, i) => scores.edges[i] + width / 2);
  const part = (name, y, color) => ({ type: "bar", name, x: middle, y, width: wide, marker: { color } });
  const traces = [part("kept", scores.kept, "#2563a8"), ...(scores.removed.some(Boolean) ? [part("removed", scores.removed, "#d62728")] : [])];
  Plotly.react("scores", traces, layout({ barmode: "stack", bargap: 0, xaxis: { title: { text: "score, higher is noisier" } }, yaxis: { title: { text: "voxels" }, type: "log" }, showlegend: traces.length > 1, legend: { x: 1, xanchor: "right", y: 1 } }), PLOT);
}

function drawNoise(noise) {
  const trace = { type: "heatmap", z: noise.mm, dx: noise.cell_px, dy: noise.cell_px, x0: noise.cell_px / 2, y0: noise.cell_px / 2, colorscale: "Viridis", colorbar: { thickness: 12 }, hovertemplate: "u %{x:.0f}, v %{y:.0f} px: %{z:.1f} mm<extra></extra>" };
  Plotly.react("noise", [trace], layout({ margin: { l: 35, r: 10, t: 5, b: 30 }, yaxis: { autorange: "reversed", scaleanchor: "x", constrain: "domain" }, xaxis: { constrain: "domain" } }), PLOT);
}

const ORE_COLUMNS = [
  ["ore", ore => ore.id],
  ["target", ore => ore.rank],
  ["oversize", ore => ({ true: "yes", false: "no" })[ore.oversize] ?? "?", null, "text"],
  ["size [mm]", ore => ore.size_m && ore.size_m[0], ore => ore.size_m ? ore.size_m.map(length => fixed(length, 0, 1000)).join(" × ") : ""],
  ["volume [l]", ore => ore.volume_m3, ore => fixed(ore.volume_m3, 2, 1000)],
  ["centre, camera [m]", ore => ore.centre && ore.centre.camera[2], ore => ore.centre ? vector(ore.centre.camera) : ""],
  ["centre, arm [m]", ore => ore.centre && ore.centre.arm && ore.centre.arm[2], ore => ore.centre ? vector(ore.centre.arm) : ""],
  ["± [mm]", ore => ore.centre && Math.max(...ore.centre.sigma_m), ore => ore.centre ? fixed(Math.max(...ore.centre.sigma_m), 0, 1000) : ""],
  ["strike, arm [m]", ore => ore.strike && ore.strike.point.arm && ore.strike.point.arm[2], ore => ore.strike ? vector(ore.strike.point.arm) : ""],
  ["slope [°]", ore => ore.strike && ore.strike.slope_deg, ore => ore.strike ? fixed(ore.strike.slope_deg, 0) : ""],
  ["score", ore => ore.strike && ore.strike.score, ore => ore.strike ? fixed(ore.strike.score, 2) : ""],
  ["reasons", ore => [...new Set(ore.reasons), ...(ore.cut ? ["cut by the image border"] : [])].join(", "), null, "text"],
];

function drawDetail(detail) {
  drawCloudSoon(detail);
  let before = null;
  bars(at("counts"), Object.entries(detail.counts).map(([name, value]) => {
    const share = before && name !== "ores" && name !== "targets" ? ` (${(100 * value / before).toFixed(0)} %)` : "";
    before = value;
    return [name, Math.log10(1 + value), value.toLocaleString("en") + share];
  }));
  if (detail.scores) drawScores(detail.scores);
  if (detail.noise) drawNoise(detail.noise);
  bars(at("stages"), Object.entries(detail.timings || {}).map(([name, ms]) => [name, ms, `${ms.toFixed(0)} ms`]));
  const rank = new Map(detail.targets.map((id, place) => [id, place + 1]));
  sortable(at("ores"), ORE_COLUMNS, detail.ores.map(ore => ({ ...ore, rank: rank.get(ore.id) ?? null })));
}

function choose(place) {
  const frame = data.frames[place], detail = data.details[place];
  at("frame-title").textContent = `Frame ${frame.frame}: ${frame.status}, ${plural(frame.ores, "ore")}, ${plural(frame.targets, "target")}`;
  at("frame-reasons").textContent = frame.reasons.join(" · ") + (detail ? "" : " The 3-D view, the charts and the ores are kept for the frames marked 3-D.");
  showPicture(frame, place, detail);
  for (const id of ["detail", "ores", "cloud", "cloud-caption"]) at(id).hidden = !detail;
  if (detail) drawDetail(detail);
  for (const element of document.querySelectorAll("#strip button")) element.setAttribute("aria-current", String(Number(element.dataset.place) === place));
  for (const element of document.querySelectorAll("#frames tbody tr")) element.classList.toggle("chosen", Number(element.dataset.place) === place);
}

function showPicture(frame, place, detail) {
  const image = at("overlay"), small = data.thumbnails[place];
  image.parentElement.hidden = frame.status === "failed" && !detail?.overlay && !small;
  image.onerror = () => { image.onerror = null; if (small) image.src = small; };
  // A frame without an embedded picture has one beside the report, as long as the folder stays together.
  image.src = detail?.overlay || `overlays/${encodeURIComponent(frame.frame)}.png`;
}

// --- the run

function drawStrip() {
  if (data.frames.length < 2) return;
  at("strip").replaceChildren(...Object.entries(data.thumbnails).map(([place, picture]) => stripButton(Number(place), picture)));
}

function stripButton(place, picture) {
  const frame = data.frames[place], button = make("button");
  button.dataset.place = place;
  button.title = `${frame.frame}: ${frame.status}`;
  const image = button.appendChild(make(picture ? "img" : "div", "", picture ? "" : "missing"));
  if (picture) { image.src = picture; image.alt = ""; }
  button.append(make("span", (data.details[place] ? "3-D · " : "") + frame.frame, `name ${frame.status}`));
  button.addEventListener("click", () => choose(place));
  return button;
}

const FRAME_COLUMNS = [
  ["number", frame => frame.index],
  ["frame", frame => frame.frame, null, "text"],
  ["status", frame => frame.status, null, "text"],
  ["ores", frame => frame.ores],
  ["oversize", frame => frame.oversize],
  ["targets", frame => frame.targets],
  ["largest, middle dimension [mm]", frame => frame.largest_m, frame => fixed(frame.largest_m, 0, 1000)],
  ["time [ms]", frame => frame.total_ms, frame => fixed(frame.total_ms, 0)],
  ["reasons", frame => frame.reasons.join(" · "), null, "text long"],
];

function drawSizes() {
  const { place, middle_m, oversize } = data.sizes;
  at("sizes-card").hidden = data.frames_total < 2 || place.length === 0;
  if (at("sizes-card").hidden) return;
  const part = (name, state, color) => {
    const chosen = place.map((_, i) => i).filter(i => oversize[i] === state);
    return { type: "scatter", mode: "markers", name, x: chosen.map(i => place[i]), y: chosen.map(i => 1000 * middle_m[i]), marker: { color, size: 5, opacity: 0.6 } };
  };
  const groups = new Map();
  place.forEach((frame, i) => groups.set(frame, [...(groups.get(frame) || []), 1000 * middle_m[i]]));
  const median = values => values.sort((a, b) => a - b)[Math.floor(values.length / 2)];
  const middle = { type: "scatter", mode: "lines", name: "median", x: [...groups.keys()], y: [...groups.values()].map(median), line: { color: "#333", width: 1.5 } };
  const traces = [part("oversize", true, "#d62728"), part("passes", false, "#2ca02c"), part("unknown", null, "#e0a000"), middle].filter(trace => trace.x.length);
  const opening = data.opening_m ? [{ type: "line", xref: "paper", x0: 0, x1: 1, y0: 1000 * data.opening_m, y1: 1000 * data.opening_m, line: { dash: "dash", color: "#888" } }] : [];
  Plotly.newPlot("sizes", traces, layout({ xaxis: { title: { text: "frame" } }, yaxis: { title: { text: "mm" }, rangemode: "tozero" }, shapes: opening, showlegend: true }), PLOT);
}

function drawRun() {
  const counts = Object.entries(data.statuses).map(([status, count]) => `${count} ${status}`).join(", ");
  at("summary").textContent = `${plural(data.frames_total, "frame")}: ${counts}${data.run.finished ? "" : " (the run is not finished)"}`;
  for (const [status, count] of Object.entries(data.statuses)) at("chips").append(make("span", `${count} ${status}`, `chip ${status}`));
  if (data.check) at("chips").append(make("span", `calibration: ${data.check.verdict}`, `chip ${data.check.verdict}`));
  at("frames-note").textContent = data.frames.length < data.frames_total ? `${data.frames.length} of ${data.frames_total}, spread evenly; all are in frames.jsonl.` : "Click a heading to sort, a row to show the frame.";
  sortable(at("frames"), FRAME_COLUMNS, data.frames, (frame, place) => { choose(place); at("frame").scrollIntoView(); });
  sortable(at("reasons"), [["of", entry => entry.of, null, "text"], ["code", entry => entry.code, null, "text"], ["times", entry => entry.count], ["for example", entry => entry.example, null, "text long"]], data.reasons);
  bars(at("medians"), Object.entries(data.timings).map(([name, ms]) => [name, ms, `${ms.toFixed(0)} ms`]));
  drawSizes();
  drawCheck();
}

function drawCheck() {
  const check = data.check;
  if (!check) { at("check").append(make("p", "Not checked in this run: stereo-ore calibrate check judges a calibration by a pair.", "note")); return; }
  at("check").append(make("span", check.verdict, `chip ${check.verdict}`), make("p", check.text));
  for (const finding of check.findings) at("check").append(make("p", `${finding.severity}: ${finding.code}: ${finding.text}`));
}

function drawInputs() {
  const rows = [["source", data.run.source], ["recording", data.run.recording], ["versions", data.run.versions], ["search", data.run.search], ["files", data.run.files]];
  const text = value => typeof value === "string" ? value : JSON.stringify(value).replaceAll(/[{}"]/g, " ");
  at("made").replaceChildren(...rows.filter(([, value]) => value).map(([name, value]) => {
    const line = make("tr");
    line.append(make("td", name, "text"), make("td", text(value), "text long"));
    return line;
  }));
  for (const [name, content] of Object.entries(data.files)) {
    const box = at("files").appendChild(make("details"));
    box.append(make("summary", name), make("pre", content));
  }
}

drawRun();
drawInputs();
drawStrip();
if (data.frames.length) choose(Number(Object.keys(data.details)[0]));
