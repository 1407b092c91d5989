// The page: charts of a frame, filmstrip, the run.

const data = JSON.parse(document.getElementById("data").textContent);

function drawScores(scores) {
  const wide = scores.edges.slice(1).map((edge, i) => edge - scores.edges[i]),
    middle = wide.map((width, i) => scores.edges[i] + width / 2);
  const part = (name, y, color) => ({ type: "bar", name, x: middle, y, width: wide, marker: { color } });
  const traces = [
    part("kept", scores.kept, "#2563a8"),
    ...(scores.removed.some(Boolean) ? [part("removed", scores.removed, "#d62728")] : []),
  ];
  Plotly.react(
    "scores",
    traces,
    layout({
      barmode: "stack",
      bargap: 0,
      xaxis: { title: { text: "score, higher is noisier" } },
      yaxis: { title: { text: "voxels" }, type: "log" },
      showlegend: traces.length > 1,
      legend: { x: 1, xanchor: "right", y: 1 },
    }),
    PLOT,
  );
}

function drawNoise(noise) {
  const trace = {
    type: "heatmap",
    z: noise.mm,
    dx: noise.cell_px,
    dy: noise.cell_px,
    x0: noise.cell_px / 2,
    y0: noise.cell_px / 2,
    colorscale: "Viridis",
    colorbar: { thickness: 12 },
    hovertemplate: "u %{x:.0f}, v %{y:.0f} px: %{z:.1f} mm<extra></extra>",
  };
  Plotly.react(
    "noise",
    [trace],
    layout({
      margin: { l: 35, r: 10, t: 5, b: 30 },
      yaxis: { autorange: "reversed", scaleanchor: "x", constrain: "domain" },
      xaxis: { constrain: "domain" },
    }),
    PLOT,
  );
}

const ORE_COLUMNS = [
  ["ore", ore => ore.id],
  ["target", ore => ore.rank],
  ["oversize", ore => ({ true: "yes", false: "no" })[ore.oversize] ?? "?", null, "text"],
  [
    "size [mm]",
    ore => ore.size_m && ore.size_m[0],
    ore => (ore.size_m ? ore.size_m.map(length => fixed(length, 0, 1000)).join(" × ") : ""),
  ],
  ["volume [l]", ore => ore.volume_m3, ore => fixed(ore.volume_m3, 2, 1000)],
  [
    "centre, camera [m]",
    ore => ore.centre && ore.centre.camera[2],
    ore => (ore.centre ? vector(ore.centre.camera) : ""),
  ],
  [
    "centre, arm [m]",
    ore => ore.centre && ore.centre.arm && ore.centre.arm[2],
    ore => (ore.centre ? vector(ore.centre.arm) : ""),
  ],
  [
    "± [mm]",
    ore => ore.centre && Math.max(...ore.centre.sigma_m),
    ore => (ore.centre ? fixed(Math.max(...ore.centre.sigma_m), 0, 1000) : ""),
  ],
  [
    "strike, arm [m]",
    ore => ore.strike && ore.strike.point.arm && ore.strike.point.arm[2],
    ore => (ore.strike ? vector(ore.strike.point.arm) : ""),
  ],
  ["slope [°]", ore => ore.strike && ore.strike.slope_deg, ore => (ore.strike ? fixed(ore.strike.slope_deg, 0) : "")],
  ["score", ore => ore.strike && ore.strike.score, ore => (ore.strike ? fixed(ore.strike.score, 2) : "")],
  [
    "reasons",
    ore => [...new Set(ore.reasons), ...(ore.cut ? ["cut by the image border"] : [])].join(", "),
    null,
    "text",
  ],
];

function drawDetail(detail) {
  drawCloudSoon(detail);
  let before = null;
  bars(
    at("counts"),
    Object.entries(detail.counts).map(([name, value]) => {
      const share =
        before && name !== "ores" && name !== "targets" ? ` (${((100 * value) / before).toFixed(0)} %)` : "";
      before = value;
      return [name, Math.log10(1 + value), value.toLocaleString("en") + share];
    }),
  );
  at("losses").replaceChildren(
    ...detail.losses.map(loss => {
      const entry = document.createElement("li");
      entry.textContent = `${loss.count.toLocaleString("en")} ${loss.unit}: ${loss.detail} (${loss.code})`;
      return entry;
    }),
  );
  if (detail.scores) drawScores(detail.scores);
  if (detail.noise) drawNoise(detail.noise);
  bars(
    at("stages"),
    Object.entries(detail.timings || {}).map(([name, ms]) => [name, ms, `${ms.toFixed(0)} ms`]),
  );
}

// The best target first, what is none last.
function drawOres(table) {
  const rank = new Map(table.targets.map((id, place) => [id, place + 1]));
  const rows = table.ores.map(ore => ({ ...ore, rank: rank.get(ore.id) ?? null }));
  rows.sort((a, b) => (a.rank ?? Infinity) - (b.rank ?? Infinity) || a.id - b.id);
  sortable(at("ores"), ORE_COLUMNS, rows, { key: ore => ore.id, onRow: mark, chosen: id => id === marked });
}

let current = null;

function choose(place) {
  const frame = data.frames[place],
    detail = data.details[place];
  current = place;
  marked = null;
  at("frame-title").textContent =
    `Frame ${frame.frame}: ${frame.status}, ${plural(frame.ores, "ore")}, ${plural(frame.targets, "target")}`;
  at("frame-stamp").textContent = stamp(frame) && `${stamp(frame)} UTC (${frame.stamp_source || "source unknown"})`;
  const more = detail ? [] : ["The 3-D view and the charts are kept for the frames marked 3-D."];
  at("frame-reasons").textContent = [...frame.reasons, ...more].join(" · ");
  showPicture(frame, place, detail);
  const table = detail || data.tables[place];
  for (const id of ["detail", "cloud", "cloud-caption"]) at(id).hidden = !detail;
  at("ores").hidden = !table;
  if (detail) drawDetail(detail);
  if (table) drawOres(table);
  drawLumps(table ? table.ores : []);
  for (const element of document.querySelectorAll("#strip button")) {
    const chosen = Number(element.dataset.place) === place;
    element.setAttribute("aria-current", String(chosen));
    const strip = at("strip"),
      left = element.offsetLeft - strip.offsetLeft;
    if (chosen && (left < strip.scrollLeft || left + element.offsetWidth > strip.scrollLeft + strip.clientWidth))
      strip.scrollLeft = left - strip.clientWidth / 2;
  }
  for (const element of document.querySelectorAll("#frames tbody tr"))
    element.classList.toggle("chosen", Number(element.dataset.place) === place);
}

// --- the run

// Which frames are shown: [name, count, what a frame must be].
const BAD = ["degraded", "failed", "skipped"];
const FILTERS = [
  ["all", data.frames_total, () => true],
  ...(BAD.some(status => data.statuses[status])
    ? [["bad", BAD.reduce((sum, status) => sum + (data.statuses[status] || 0), 0), f => BAD.includes(f.status)]]
    : []),
  ...Object.entries(data.statuses).map(([status, count]) => [status, count, frame => frame.status === status]),
];
let places = data.frames.map((_, place) => place);

function filterFrames(wanted) {
  const [, , fits] = FILTERS.find(([name]) => name === wanted);
  places = data.frames.map((_, place) => place).filter(place => fits(data.frames[place]));
  for (const chip of document.querySelectorAll("#chips button"))
    chip.setAttribute("aria-pressed", String(chip.dataset.filter === wanted));
  drawStrip();
  drawFrames();
  if (places.length) choose(places.includes(current) ? current : places[0]);
}

function drawChips() {
  if (data.frames.length < 2) return;
  for (const [name, count] of FILTERS) {
    const chip = at("chips").appendChild(make("button", `${count} ${name}`, `chip ${name}`));
    chip.dataset.filter = name;
    chip.addEventListener("click", () => filterFrames(name));
  }
}

document.addEventListener("keydown", event => {
  const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
  if (!step || event.altKey || event.ctrlKey || event.metaKey || event.shiftKey) return;
  const next = places[places.indexOf(current) + step];
  if (next === undefined) return;
  event.preventDefault();
  choose(next);
});

const MOST_IN_STRIP = 120;
function drawStrip() {
  if (data.frames.length < 2) return;
  const few = places.length <= MOST_IN_STRIP ? places : places.filter(place => place in data.thumbnails);
  at("strip").replaceChildren(...few.map(place => stripButton(place, data.thumbnails[place])));
}

function stripButton(place, picture) {
  const frame = data.frames[place],
    button = make("button");
  button.dataset.place = place;
  button.title = `${frame.frame}: ${frame.status}`;
  const image = button.appendChild(make(picture ? "img" : "div", "", picture ? "" : "missing"));
  if (picture) {
    image.src = picture;
    image.alt = "";
  }
  button.append(make("span", (data.details[place] ? "3-D · " : "") + frame.frame, `name ${frame.status}`));
  button.addEventListener("click", () => choose(place));
  return button;
}

// To the millisecond; all nine digits are in frames.jsonl.
const stamp = frame => (frame.stamp_utc ? frame.stamp_utc.slice(0, 23).replace("T", " ") : "");

const FRAME_COLUMNS = [
  ["number", frame => frame.index],
  ["frame", frame => frame.frame, null, "text"],
  ["status", frame => frame.status, null, "text"],
  ["ores", frame => frame.ores],
  ["oversize", frame => frame.oversize],
  ["targets", frame => frame.targets],
  ["largest, middle dimension [mm]", frame => frame.largest_m, frame => fixed(frame.largest_m, 0, 1000)],
  ["bars off [mm]", frame => frame.bars_off_m, frame => fixed(frame.bars_off_m, 1, 1000)],
  ["under fines [%]", frame => frame.fines_share, frame => fixed(frame.fines_share, 1, 100)],
  ["time [ms]", frame => frame.total_ms, frame => fixed(frame.total_ms, 0)],
  ["stamp [UTC]", frame => frame.stamp_utc, stamp, "text"],
  ["reasons", frame => frame.reasons.join(" · "), null, "text long"],
];

function drawSizes() {
  const { place, middle_m, oversize } = data.sizes;
  at("sizes-card").hidden = data.frames_total < 2 || place.length === 0;
  if (at("sizes-card").hidden) return;
  const part = (name, state, color) => {
    const chosen = place.map((_, i) => i).filter(i => oversize[i] === state);
    return {
      type: "scatter",
      mode: "markers",
      name,
      x: chosen.map(i => place[i]),
      y: chosen.map(i => 1000 * middle_m[i]),
      marker: { color, size: 5, opacity: 0.6 },
    };
  };
  const groups = new Map();
  place.forEach((frame, i) => groups.set(frame, [...(groups.get(frame) || []), 1000 * middle_m[i]]));
  const median = values => values.sort((a, b) => a - b)[Math.floor(values.length / 2)];
  const middle = {
    type: "scatter",
    mode: "lines",
    name: "median",
    x: [...groups.keys()],
    y: [...groups.values()].map(median),
    line: { color: "#333", width: 1.5 },
  };
  const traces = [
    part("oversize", true, "#d62728"),
    part("passes", false, "#2ca02c"),
    part("unknown", null, "#e0a000"),
    middle,
  ].filter(trace => trace.x.length);
  const opening = data.opening_m
    ? [
        {
          type: "line",
          xref: "paper",
          x0: 0,
          x1: 1,
          y0: 1000 * data.opening_m,
          y1: 1000 * data.opening_m,
          line: { dash: "dash", color: "#888" },
        },
      ]
    : [];
  Plotly.newPlot(
    "sizes",
    traces,
    layout({
      xaxis: { title: { text: "frame" } },
      yaxis: { title: { text: "mm" }, rangemode: "tozero" },
      shapes: opening,
      showlegend: true,
    }),
    PLOT,
  );
}

function drawRun() {
  const counts = Object.entries(data.statuses)
    .map(([status, count]) => `${count} ${status}`)
    .join(", ");
  at("summary").textContent =
    `${plural(data.frames_total, "frame")}: ${counts}${data.run.finished ? "" : " (the run is not finished)"}`;
  const day = text => text.slice(0, 19).replace("T", " ");
  const { camera, from_utc: from, to_utc: to } = data.run;
  const when = from && (from === to ? `${day(from)} UTC` : `${day(from)} to ${day(to)} UTC`);
  at("made-of").textContent = [camera && `camera ${camera}`, when].filter(Boolean).join(", ");
  drawChips();
  if (data.check) at("chips").append(make("span", `calibration: ${data.check.verdict}`, `chip ${data.check.verdict}`));
  at("frames-note").textContent =
    data.frames.length < data.frames_total
      ? `${data.frames.length} of ${data.frames_total}, spread evenly; all are in frames.jsonl.`
      : "Click a heading to sort, a row to show the frame. ← and → go from frame to frame; the buttons on top choose which.";
  sortable(
    at("reasons"),
    [
      ["of", entry => entry.of, null, "text"],
      ["code", entry => entry.code, null, "text"],
      ["times", entry => entry.count],
      ["for example", entry => entry.example, null, "text long"],
    ],
    data.reasons,
  );
  bars(
    at("medians"),
    Object.entries(data.timings).map(([name, ms]) => [name, ms, `${ms.toFixed(0)} ms`]),
  );
  drawSizes();
  drawBarsOff();
  drawCheck();
}

function drawFrames() {
  sortable(
    at("frames"),
    FRAME_COLUMNS,
    places.map(place => ({ ...data.frames[place], place })),
    {
      key: frame => frame.place,
      chosen: place => place === current,
      onRow: place => {
        choose(place);
        at("frame").scrollIntoView();
      },
    },
  );
}

function drawBarsOff() {
  const known = data.frames.filter(frame => frame.bars_off_m !== null);
  at("bars-card").hidden = known.length < 2;
  if (known.length < 2) return;
  const trace = {
    type: "scatter",
    mode: "lines+markers",
    x: known.map(frame => frame.index),
    y: known.map(frame => 1000 * frame.bars_off_m),
    text: known.map(frame => frame.frame),
    line: { color: "#2563a8", width: 1.5 },
    marker: { size: 4 },
  };
  Plotly.newPlot(
    "bars-off",
    [trace],
    layout({ xaxis: { title: { text: "frame" } }, yaxis: { title: { text: "mm" }, rangemode: "tozero" } }),
    PLOT,
  );
}

function drawCheck() {
  const check = data.check;
  if (!check) {
    at("check").append(
      make("p", "Not checked in this run: stereo-ore calibrate check judges a calibration by a pair.", "note"),
    );
    return;
  }
  at("check").append(make("span", check.verdict, `chip ${check.verdict}`), make("p", check.text));
  for (const finding of check.findings)
    at("check").append(make("p", `${finding.severity}: ${finding.code}: ${finding.text}`));
}

function drawInputs() {
  const rows = [
    ["source", data.run.source],
    ["recording", data.run.recording],
    ["versions", data.run.versions],
    ["search", data.run.search],
    ["files", data.run.files],
  ];
  const text = value => (typeof value === "string" ? value : JSON.stringify(value).replaceAll(/[{}"]/g, " "));
  at("made").replaceChildren(
    ...rows
      .filter(([, value]) => value)
      .map(([name, value]) => {
        const line = make("tr");
        line.append(make("td", name, "text"), make("td", text(value), "text long"));
        return line;
      }),
  );
  for (const [name, content] of Object.entries(data.files)) {
    const box = at("files").appendChild(make("details"));
    box.append(make("summary", name), make("pre", content));
  }
}

drawRun();
drawInputs();
filterFrames("all");
