// The same crop of every picture of a frame, side by side.
function cropBox() {
  const { width, height } = sizeOf(), size = Math.min(state.crop.size, width, height);
  const place = (middle, room) => Math.round(Math.min(room - size, Math.max(0, middle * room - size / 2)));
  return { x: place(state.crop.x, width), y: place(state.crop.y, height), size };
}

function placeCrop(at) {
  if (!at) return;
  const { width, height } = sizeOf();
  state.crop.x = (at.x + 0.5) / width;
  state.crop.y = (at.y + 0.5) / height;
  draw();
}

const cropFigures = [];
function buildCrops() {
  for (const [i, column] of columns.entries()) {
    const figure = element("figure", { "data-column": i });
    const caption = element("figcaption", {}, element("b", { title: column.label }, column.label), element("span", { class: "faint" }));
    const [own, map] = [element("canvas", { role: "img" }), element("canvas", { role: "img" })];
    figure.append(own, map, caption);
    for (const area of [own, map]) dragCrop(area);
    cropFigures.push({ figure, own, map, text: caption.lastChild });
    $("crops").append(figure);
  }
}

function dragCrop(area) {
  let last = null;
  area.addEventListener("pointerdown", (event) => {
    last = event;
    area.setPointerCapture(event.pointerId);
  });
  area.addEventListener("pointermove", (event) => {
    if (!last) return;
    const { width, height } = sizeOf(), scale = cropBox().size / area.clientWidth;
    state.crop.x = Math.min(1, Math.max(0, state.crop.x - ((event.clientX - last.clientX) * scale) / width));
    state.crop.y = Math.min(1, Math.max(0, state.crop.y - ((event.clientY - last.clientY) * scale) / height));
    last = event;
    draw();
  });
  for (const kind of ["pointerup", "pointercancel"]) area.addEventListener(kind, () => (last = null));
}

// Crops wait until the page is complete, the large picture is there and they are near what is seen.
let cropsSeen = false;
new IntersectionObserver(([entry]) => {
  cropsSeen = entry.isIntersecting;
  if (cropsSeen) draw();
}, { rootMargin: "300px" }).observe($("crops-card"));

function drawCrops() {
  $("crops-card").hidden = state.frame < 0;
  if (!cropsSeen || document.readyState === "loading" || state.frame < 0 || (has(state.frame, state.a) && !picture(state.frame, state.a, "p"))) return;
  const box = cropBox(), below = $("crop-map").value;
  for (const [i, { figure, own, map, text }] of cropFigures.entries()) {
    figure.hidden = !has(state.frame, i);
    figure.classList.toggle("shown", i === state.a);
    if (figure.hidden) continue;
    paintCrop(own, i, "image", box, `${columns[i].label}, crop`);
    map.hidden = !below || REFERENCE < 0;
    if (!map.hidden) paintCrop(map, i, below, box, `${columns[i].label}, error`);
    text.textContent = captionOf(i);
  }
}

// The crop of a picture as a picture of its own.
function cut(image, { x, y, size }) {
  if (!image || x + size > image.width || y + size > image.height) return null;
  const count = image.levels.length / (image.width * image.height), levels = new Int16Array(size * size * count);
  const marks = image.marks && new Uint8Array(size * size);
  for (let row = 0; row < size; row++) {
    const from = (y + row) * image.width + x;
    levels.set(image.levels.subarray(from * count, (from + size) * count), row * size * count);
    marks?.set(image.marks.subarray(from, from + size), row * size);
  }
  return { width: size, height: size, levels, marks, largest: image.largest };
}

function paintCrop(area, column, kind, box, label) {
  const { size } = box, target = area.getContext("2d");
  if (area.width !== size) area.width = area.height = size;
  area.setAttribute("aria-label", label);
  target.clearRect(0, 0, size, size);
  if (kind !== "image" && !compared(state.frame, column)) return;
  const image = cut(picture(state.frame, column, kind === "flip" ? "f" : "p"), box);
  const wanted = kind === "relmse" ? cut(picture(state.frame, REFERENCE, "p"), box) : image;
  if (!image || !wanted) return;
  const pixels = target.createImageData(size, size);
  paint(image, column, wanted, kind, new Uint32Array(pixels.data.buffer));
  target.putImageData(pixels, 0, 0);
}

function captionOf(column) {
  const scores = facts.scores[columns[column].label], first = metrics.findIndex((m) => m.name === $("plot-metric").value);
  const value = scores?.[state.frame]?.[first];
  return columns[column].kind === "reference" ? "reference" : value === undefined || first < 0 ? "" : `${metrics[first].name} ${value === null ? "–" : printed(value, metrics[first].digits)}`;
}

// As Python's formats "4f" and "4g" do, but without exponents.
function printed(value, digits) {
  if (typeof value === "string") return value;
  const count = parseInt(digits), text = digits.endsWith("g") ? String(Number(value.toPrecision(count))) : value.toFixed(count);
  return text.replace("-", "−");
}
