// The large picture: what is shown, where, and what lies under the pointer.
const state = {
  frame: pictures.frames[0] ?? -1, a: 0, b: 0, kind: "image", stops: 0, curve: "gamma",
  split: false, divider: 0.5, zoom: null, x: 0.5, y: 0.5, pointer: null, crop: { x: 0.5, y: 0.5, size: 64 },
};
const canvas = $("canvas"), stage = $("stage"), context = canvas.getContext("2d");

function sizeOf(frame = state.frame) {
  return frames[frame] ? { width: frames[frame].width, height: frames[frame].height } : { width: 16, height: 9 };
}

// Screen pixels per picture pixel: the whole picture where no zoom is chosen.
function fitting() {
  const { width, height } = sizeOf();
  return Math.min(canvas.width / width, canvas.height / height);
}
const scaleNow = () => state.zoom ?? fitting();

// Left upper corner of the picture on the canvas; the picture is kept in view.
function origin() {
  const { width, height } = sizeOf(), scale = scaleNow();
  const place = (middle, size, room) => {
    if (size * scale <= room) return (room - size * scale) / 2;
    return Math.min(0, Math.max(room - size * scale, room / 2 - middle * size * scale));
  };
  return { x: Math.round(place(state.x, width, canvas.width)), y: Math.round(place(state.y, height, canvas.height)), scale };
}

// Takes the middle of the view from where the picture came to lie.
function settleView() {
  const { width, height } = sizeOf(), { x, y, scale } = origin();
  state.x = (canvas.width / 2 - x) / (width * scale);
  state.y = (canvas.height / 2 - y) / (height * scale);
}

function zoomTo(scale, at = { x: canvas.width / 2, y: canvas.height / 2 }) {
  const { width, height } = sizeOf(), before = origin();
  const px = (at.x - before.x) / before.scale, py = (at.y - before.y) / before.scale;
  const fit = fitting(), next = Math.min(128, Math.max(Math.min(fit, 1), scale));
  state.zoom = Math.abs(next / fit - 1) < 0.01 ? null : next;
  const now = scaleNow();
  state.x = (canvas.width / 2 - at.x + px * now) / (width * now);
  state.y = (canvas.height / 2 - at.y + py * now) / (height * now);
  settleView();
  draw();
}

function moveBy(dx, dy) {
  const { width, height } = sizeOf(), scale = scaleNow();
  state.x -= dx / (width * scale);
  state.y -= dy / (height * scale);
  settleView();
  draw();
}

function pixelAt(x, y) {
  const { width, height } = sizeOf(), from = origin();
  const px = Math.floor((x - from.x) / from.scale), py = Math.floor((y - from.y) / from.scale);
  return px >= 0 && py >= 0 && px < width && py < height ? { x: px, y: py } : null;
}

let drawing = 0;
function draw() {
  drawing ||= requestAnimationFrame(() => {
    drawing = 0;
    drawStage();
    drawCrops();
    showValues();
    $("busy").hidden = !waiting();
  });
}

function drawStage() {
  const { width, height } = stage.getBoundingClientRect(), ratio = devicePixelRatio || 1;
  const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== w || canvas.height !== h) {
    canvas.width = w;
    canvas.height = h;
  }
  context.clearRect(0, 0, w, h);
  const from = origin();
  const cut = Math.round(state.divider * w);
  drawOne(state.a, from, 0, state.split ? cut : w);
  if (state.split) drawOne(state.b, from, cut, w);
  drawCropFrame(from);
  $("zoom-text").value = state.zoom === null ? "fit" : `${digits(from.scale, 3)}×`;
  canvas.style.touchAction = state.zoom === null ? "pan-y" : "none";
}

function drawOne(column, from, left, right) {
  const kind = kindOf(state.frame, column, state.kind);
  const shown = state.frame >= 0 && has(state.frame, column) ? shade(state.frame, column, kind) : null;
  context.save();
  context.beginPath();
  context.rect(left, 0, right - left, canvas.height);
  context.clip();
  if (shown) {
    if (!performance.getEntriesByName("first picture").length) performance.mark("first picture");
    context.imageSmoothingEnabled = from.scale < 1;
    context.imageSmoothingQuality = "high";
    context.drawImage(shown, from.x, from.y, shown.width * from.scale, shown.height * from.scale);
  } else if (!waiting() || !has(state.frame, column)) {
    context.fillStyle = "#bbb";
    context.font = `${14 * (devicePixelRatio || 1)}px system-ui, sans-serif`;
    context.textAlign = "center";
    context.fillText(state.frame < 0 ? "There are no pictures" : "No picture", (left + right) / 2, canvas.height / 2);
  }
  context.restore();
}

function drawCropFrame(from) {
  if (!$("crops").childElementCount || state.frame < 0) return;
  const { x, y, size } = cropBox(), ratio = devicePixelRatio || 1;
  context.lineWidth = ratio;
  for (const [color, grow] of [["#000a", 1.5], ["#fff", 0.5]]) {
    context.strokeStyle = color;
    const g = grow * ratio;
    context.strokeRect(from.x + x * from.scale - g, from.y + y * from.scale - g, size * from.scale + 2 * g, size * from.scale + 2 * g);
  }
}

// Numbers as a renderer's user reads them: four digits, words where there is no number.
function digits(value, count = 4) {
  if (value === null || value === undefined) return "–";
  if (typeof value === "string") return value;
  if (value !== value) return "NaN";
  if (value === 0) return "0";
  const size = Math.abs(value);
  const text = size >= 1e5 || size < 1e-4 ? value.toExponential(Math.max(0, count - 2)) : String(+value.toPrecision(count));
  return text.replace("-", "−");
}

function readable() {
  const order = [state.a, state.b];
  if (REFERENCE >= 0) order.push(REFERENCE);
  for (const i of columns.keys()) if (images.get(`${state.frame}-${i}p`)?.image) order.push(i);
  return [...new Set(order)].filter((i) => state.frame >= 0 && has(state.frame, i));
}

function showValues() {
  const at = state.pointer, head = $("readout").tHead, body = $("readout").tBodies[0];
  const where = at ? `pixel ${at.x}, ${at.y}` : "point at a pixel";
  head.replaceChildren(element("tr", {}, ...[where, "R", "G", "B", ...(REFERENCE >= 0 ? ["relMSE", "FLIP"] : [])].map((t) => element("th", { scope: "col" }, t))));
  body.replaceChildren(...readable().map((column) => {
    const image = at && picture(state.frame, column, "p");
    const inside = image && at.x < image.width && at.y < image.height;
    const values = inside ? radianceAt(image, state.frame, column, at.x, at.y) : [null, null, null];
    const row = element("tr", { "data-column": column }, element("th", { scope: "row", title: columns[column].label }, columns[column].label));
    values.forEach((v) => row.append(element("td", { "data-value": v ?? "" }, digits(v))));
    if (REFERENCE >= 0) row.append(...errorsAt(column, image, at).map((v) => element("td", {}, digits(v, 3))));
    return row;
  }));
}

function errorsAt(column, image, at) {
  if (!at || !image || !compared(state.frame, column)) return [null, null];
  const target = picture(state.frame, REFERENCE, "p"), place = at.y * image.width + at.x;
  const map = images.get(`${state.frame}-${column}f`)?.image;
  const same = target && target.width === image.width && target.height === image.height;
  return [same ? relmseAt(image, column, target, place) : null, map ? map.levels[place] / pictures.flip : null];
}
