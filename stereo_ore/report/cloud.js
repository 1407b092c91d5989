// What all plots share, and the 3-D view.

const PLOT = { displaylogo: false, responsive: true, displayModeBar: false };
const PLOT_3D = { ...PLOT, displayModeBar: "hover", modeBarButtonsToRemove: ["hoverClosest3d"] };

const layout = more => ({
  margin: { l: 50, r: 10, t: 10, b: 40 },
  paper_bgcolor: "rgba(0,0,0,0)",
  plot_bgcolor: "rgba(0,0,0,0)",
  font: { family: "system-ui, sans-serif", size: 12 },
  modebar: { bgcolor: "rgba(255,255,255,.7)", color: "#99a", activecolor: "#333" },
  ...more,
});

// The 3-D view: points, screen, solids, strikes.

const PALETTE = [
  "#e6550d",
  "#3182bd",
  "#31a354",
  "#756bb1",
  "#d6a000",
  "#c51b8a",
  "#17a2b8",
  "#8c6d31",
  "#e7298a",
  "#66a61e",
];
const STRIKE_LENGTH_M = 0.25;

function decode(text, Kind) {
  const bytes = Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
  return new Kind(bytes.buffer);
}

function points(packed) {
  const xyz = decode(packed.xyz_mm, Int16Array),
    grey = decode(packed.grey, Uint8Array),
    ore = decode(packed.ore, Uint16Array);
  const empty = () => ({ x: [], y: [], z: [], colour: [], id: [] });
  const rest = empty(),
    ores = empty();
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
  const steps = PALETTE.flatMap((colour, i) => [
    [i / PALETTE.length, colour],
    [(i + 1) / PALETTE.length, colour],
  ]);
  const marks = part => ({ type: "scatter3d", mode: "markers", x: part.x, y: part.y, z: part.z });
  const greys = {
    size: 1.6,
    color: rest.colour,
    cmin: 0,
    cmax: 255,
    colorscale: [
      [0, "#222"],
      [1, "#eee"],
    ],
  };
  const colours = { size: 2, color: ores.colour, cmin: -0.5, cmax: PALETTE.length - 0.5, colorscale: steps };
  return [
    { ...marks(rest), name: "screen and rest", marker: greys, hoverinfo: "skip" },
    {
      ...marks(ores),
      name: "ore",
      marker: colours,
      customdata: ores.id,
      hovertemplate: "ore %{customdata}<extra></extra>",
    },
    ...(detail.grizzly ? [screenTrace(detail.grizzly, rest)] : []),
  ];
}

const add = (a, b, factor = 1) => a.map((value, i) => value + factor * b[i]);
const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = a => a.map(value => value / Math.hypot(...a));

function planeAxes(normal) {
  const down = unit(add([0, 1, 0], normal, -normal[1])); // image rows, laid into the plane
  return [cross(down, normal), down];
}

function screenTrace(grizzly, rest) {
  const axes = planeAxes(grizzly.normal),
    base = grizzly.normal.map(value => value * grizzly.offset_m);
  const range = axes.map(axis => {
    const along = rest.x.map((x, i) => dot(axis, [x, rest.y[i], rest.z[i]])).sort((a, b) => a - b);
    return [along[Math.floor(0.02 * along.length)] ?? -1, along[Math.floor(0.98 * along.length)] ?? 1];
  });
  const corners = [
    [0, 0],
    [1, 0],
    [1, 1],
    [0, 1],
  ].map(([i, j]) =>
    add(add(base, axes[0], range[0][i] - dot(axes[0], base)), axes[1], range[1][j] - dot(axes[1], base)),
  );
  const axis = number => corners.map(corner => corner[number]);
  return {
    type: "mesh3d",
    name: "bar tops",
    showlegend: true,
    x: axis(0),
    y: axis(1),
    z: axis(2),
    i: [0, 0],
    j: [1, 2],
    k: [2, 3],
    opacity: 0.25,
    color: "#4477aa",
    hoverinfo: "skip",
  };
}

function lineTrace(name, segments, colour, width, more = {}) {
  const axis = number => segments.flatMap(([from, to]) => [from[number], to[number], null]);
  return {
    type: "scatter3d",
    mode: "lines",
    name,
    x: axis(0),
    y: axis(1),
    z: axis(2),
    line: { color: colour, width },
    hoverinfo: "skip",
    ...more,
  };
}

function boxEdges(ore) {
  const { centre, axes } = ore.box.camera,
    half = ore.box.extent_m.map(length => length / 2);
  const corner = bits =>
    axes.reduce((point, axis, i) => add(point, axis, bits & (1 << i) ? half[i] : -half[i]), centre);
  const edges = [];
  for (let a = 0; a < 8; a++)
    for (let i = 0; i < 3; i++) if (!(a & (1 << i))) edges.push([corner(a), corner(a | (1 << i))]);
  return edges;
}

function oreTraces(detail) {
  const solids = detail.ores.filter(ore => ore.box),
    struck = detail.ores.filter(ore => ore.strike);
  const colours = [
    ["oversize", true, "#d62728"],
    ["passes", false, "#2ca02c"],
    ["size unknown", null, "#e0a000"],
  ];
  const traces = colours.map(([name, oversize, colour]) =>
    lineTrace(`solid: ${name}`, solids.filter(ore => ore.oversize === oversize).flatMap(boxEdges), colour, 3),
  );
  const centred = solids.filter(ore => ore.centre);
  traces.push(
    pointTrace(
      "centre of gravity",
      centred.map(ore => ore.centre.camera),
      centred,
      { symbol: "cross", size: 4, color: "#00a5c8" },
    ),
  );
  traces.push(numberTrace(detail));
  const tips = struck.map(ore => ore.strike.point.camera);
  const tails = struck.map((ore, i) => add(tips[i], ore.strike.direction.camera, -STRIKE_LENGTH_M));
  traces.push(
    lineTrace(
      "strike",
      tips.map((tip, i) => [tails[i], tip]),
      "#111",
      6,
    ),
  );
  traces.push(
    pointTrace("strike point", tips, struck, {
      symbol: "diamond",
      size: 4,
      color: struck.map(ore => (ore.id === detail.targets[0] ? "#ff00c8" : "#111")),
    }),
  );
  return traces.filter(trace => trace.x.length);
}

function pointTrace(name, places, ores, marker) {
  const axis = number => places.map(place => place[number]);
  return {
    type: "scatter3d",
    mode: "markers",
    name,
    x: axis(0),
    y: axis(1),
    z: axis(2),
    text: ores.map(oreText),
    customdata: ores.map(ore => ore.id),
    hovertemplate: "%{text}<extra></extra>",
    marker,
  };
}

// As in the picture: the rank of a target in brackets, and the number; above the lump, so that nothing hides it.
const ABOVE_M = 0.1;
function numberTrace(detail) {
  const up = detail.grizzly ? detail.grizzly.normal : [0, 0, -1];
  const place = ore => add((ore.centre || ore.surface_centroid).camera, up, ABOVE_M + (ore.size_m ? ore.size_m[0] / 2 : 0));
  const trace = pointTrace("numbers", detail.ores.map(place), detail.ores, {});
  const label = ore => {
    const rank = detail.targets.indexOf(ore.id) + 1;
    return rank ? `[${rank}] ${ore.id}` : String(ore.id);
  };
  const font = { size: 15, color: "#000", weight: 700 };
  return { ...trace, mode: "text", text: detail.ores.map(label), textfont: font, hoverinfo: "skip", hovertemplate: null };
}

// The body of the marked lump; the last trace of all, empty while none is marked.
function markTrace(detail) {
  const ore = detail.ores.find(ore => ore.id === marked && ore.box);
  return lineTrace("marked", ore ? boxEdges(ore) : [], "#ff00c8", 9, { showlegend: false });
}

let inCloud = null;
function markInCloud() {
  if (!inCloud || document.body.dataset.cloud !== "drawn") return;
  const { x, y, z } = markTrace(inCloud);
  Plotly.restyle("cloud", { x: [x], y: [y], z: [z] }, [at("cloud").data.length - 1]);
}

function oreText(ore) {
  const size = ore.size_m ? ore.size_m.map(length => (1000 * length).toFixed(0)).join(" × ") + " mm" : "size unknown";
  const place =
    ore.centre &&
    (ore.centre.arm ? `centre, arm: ${vector(ore.centre.arm)} m` : `centre, camera: ${vector(ore.centre.camera)} m`);
  return [`ore ${ore.id}`, size, place].filter(Boolean).join("<br>");
}

// The 3-D view takes longest, seconds without a graphics card: the rest of the page is there before it.
let drawing = 0;
function drawCloudSoon(detail) {
  const turn = ++drawing;
  document.body.dataset.cloud = "drawing";
  at("cloud-caption").textContent = "Drawing the 3-D view …";
  requestAnimationFrame(() =>
    setTimeout(() => {
      if (turn !== drawing) return;
      drawCloud(detail);
      document.body.dataset.cloud = "drawn";
    }),
  );
}

function drawCloud(detail) {
  inCloud = detail.points ? detail : null;
  if (!detail.points) {
    Plotly.purge("cloud");
    at("cloud").replaceChildren();
    at("cloud-caption").textContent = "This frame has no cloud.";
    return;
  }
  const up = detail.grizzly ? detail.grizzly.normal : [0, 0, -1],
    back = planeAxes(up)[1];
  const eye = add(
      up.map(value => 1.4 * value),
      back,
      1.3,
    ),
    axis = text => ({ title: { text }, showspikes: false });
  const xyz = vectorOf => ({ x: vectorOf[0], y: vectorOf[1], z: vectorOf[2] });
  const scene = {
    aspectmode: "data",
    camera: { up: xyz(up), eye: xyz(eye) },
    xaxis: axis("x [m]"),
    yaxis: axis("y [m]"),
    zaxis: axis("z [m]"),
  };
  Plotly.react(
    "cloud",
    [...cloudTraces(detail), ...oreTraces(detail), markTrace(detail)],
    layout({
      margin: { l: 0, r: 0, t: 0, b: 0 },
      scene,
      showlegend: at("cloud").clientWidth > 500,
      legend: { x: 0, y: 1, itemsizing: "constant", bgcolor: "rgba(255,255,255,.7)" },
    }),
    PLOT_3D,
  );
  at("cloud").removeAllListeners("plotly_click");
  at("cloud").on("plotly_click", ({ points: [point] }) => point.customdata && mark(point.customdata));
  const [shown, all] = [detail.points.count, detail.points.of].map(count => count.toLocaleString("en"));
  at("cloud-caption").textContent =
    `${shown} of ${all} kept voxels, camera frame. Drag to turn, click a lump to mark it, the legend to hide.`;
}
