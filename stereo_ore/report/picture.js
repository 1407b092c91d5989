// The picture of a frame, and the lump that is marked: in picture, 3-D view and table alike.

let marked = null;

function mark(id) {
  marked = id === marked ? null : id;
  for (const shape of at("lumps").children) shape.classList.toggle("marked", Number(shape.dataset.ore) === marked);
  for (const row of document.querySelectorAll("#ores tbody tr")) {
    const chosen = Number(row.dataset.place) === marked;
    row.classList.toggle("chosen", chosen);
    if (chosen) showRow(row);
  }
  markInCloud();
}

// Within the table alone: the page stays where it is.
function showRow(row) {
  const box = row.closest(".scroll"),
    head = row.closest("table").tHead.offsetHeight;
  if (row.offsetTop < box.scrollTop + head) box.scrollTop = row.offsetTop - head;
  else if (row.offsetTop + row.offsetHeight > box.scrollTop + box.clientHeight)
    box.scrollTop = row.offsetTop + row.offsetHeight - box.clientHeight;
}

function drawLumps(ores) {
  if (data.image_px) at("lumps").setAttribute("viewBox", `0 0 ${data.image_px.join(" ")}`);
  // The nearest lies above those that it hides.
  const far = ore => (ore.centre ? ore.centre.camera[2] : Infinity);
  const shapes = [...ores].sort((a, b) => far(b) - far(a)).filter(ore => ore.outline_px?.length);
  at("lumps").replaceChildren(...shapes.map(lumpShape));
}

function lumpShape(ore) {
  const shape = document.createElementNS("http://www.w3.org/2000/svg", "polygon");
  shape.setAttribute("points", ore.outline_px.join(" "));
  shape.dataset.ore = ore.id;
  shape.addEventListener("click", () => mark(ore.id));
  return shape;
}

function showPicture(frame, place, detail) {
  const image = at("overlay"),
    small = data.thumbnails[place];
  image.closest("figure").hidden = ["failed", "skipped"].includes(frame.status) && !detail?.overlay && !small;
  image.onerror = () => {
    image.onerror = null;
    if (small) image.src = small;
  };
  // A frame without an embedded picture has one beside the report, as long as the folder stays together.
  image.src = detail?.overlay || `overlays/${encodeURIComponent(frame.frame)}.png`;
}

at("zoom").addEventListener("click", () => {
  const larger = at("zoom").closest("figure").classList.toggle("larger");
  at("zoom").setAttribute("aria-pressed", String(larger));
  at("zoom").textContent = larger ? "Smaller" : "Larger";
});
