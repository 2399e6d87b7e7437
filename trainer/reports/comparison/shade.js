// From levels to colours: exposure, display curves, error maps.
const CURVES = {
  gamma: (x) => Math.pow(Math.max(x, 0), 0.454545),
  srgb: (x) => encoded(Math.max(x, 0)),
  log: (x) => encoded(Math.log1p(Math.max(x, 0))),
};
const encoded = (x) => (x <= 0.0031308 ? 12.92 * x : 1.055 * Math.pow(x, 1 / 2.4) - 0.055);
const palette = new Uint32Array(256);
for (let i = 0; i < 256; i++) {
  const [r, g, b] = [0, 2, 4].map((at) => parseInt(facts.colors.slice(i * 6 + at, i * 6 + at + 2), 16));
  palette[i] = 0xff000000 | (b << 16) | (g << 8) | r;
}
const MARKS = { 1: "NaN", 2: "+Inf", 3: "−Inf" };
const NOT_FINITE = 0xffff00ff; // magenta
const RELMSE = { low: -3, high: 1 }; // powers of ten

// Exposed radiance of every level from -largest to largest.
const scales = new Map();
function valuesOf(column, largest) {
  const key = `${columns[column].bound} ${largest}`;
  if (!scales.has(key)) {
    const step = 2 * Math.log2(1 + columns[column].bound), values = new Float32Array(2 * largest + 1);
    for (let q = 0; q <= largest; q++) {
      values[largest + q] = pictures.floor * (2 ** (q * step) - 1);
      values[largest - q] = -values[largest + q];
    }
    if (scales.size > 60) scales.clear();
    scales.set(key, values);
  }
  return scales.get(key);
}

// Radiance of a pixel as the renderer wrote it; numbers, or words where it is not finite.
function radianceAt(image, frame, column, x, y) {
  const at = y * image.width + x, values = valuesOf(column, image.largest), mark = image.marks ? image.marks[at] : 0;
  return [0, 1, 2].map((c) => MARKS[(mark >> (2 * c)) & 3] ?? values[image.levels[3 * at + c] + image.largest] / (frames[frame].exposure || 1));
}

function relmseAt(image, column, target, at) {
  if ((image.marks && image.marks[at]) || (target.marks && target.marks[at])) return NaN;
  const own = valuesOf(column, image.largest), wanted = valuesOf(REFERENCE, target.largest);
  let sum = 0;
  for (let c = 0; c < 3; c++) {
    const r = wanted[target.levels[3 * at + c] + target.largest];
    sum += (own[image.levels[3 * at + c] + image.largest] - r) ** 2 / (r * r + 0.01);
  }
  return sum / 3;
}

function shadeImage(image, column, out) {
  const values = valuesOf(column, image.largest), factor = 2 ** state.stops, curve = CURVES[state.curve];
  const table = new Uint8Array(values.length);
  for (let i = 0; i < table.length; i++) table[i] = Math.round(255 * Math.min(1, curve(values[i] * factor)));
  const { levels, marks, largest } = image;
  for (let i = 0, at = 0; i < out.length; i++, at += 3) {
    out[i] = marks && marks[i] ? NOT_FINITE
      : 0xff000000 | (table[levels[at + 2] + largest] << 16) | (table[levels[at + 1] + largest] << 8) | table[levels[at] + largest];
  }
}

function shadeRelmse(image, column, target, out) {
  const scale = 255 / (RELMSE.high - RELMSE.low);
  for (let i = 0; i < out.length; i++) {
    const error = relmseAt(image, column, target, i);
    out[i] = error !== error ? NOT_FINITE : palette[Math.max(0, Math.min(255, Math.round((Math.log10(error + 1e-9) - RELMSE.low) * scale)))];
  }
}

function shadeFlip(map, out) {
  for (let i = 0; i < out.length; i++) out[i] = palette[Math.min(255, Math.round((map.levels[i] * 255) / pictures.flip))];
}

function paint(image, column, target, kind, out) {
  if (kind === "image") shadeImage(image, column, out);
  else if (kind === "relmse") shadeRelmse(image, column, target, out);
  else shadeFlip(image, out);
}

const shades = new Map(); // "frame-column-kind" → canvas with its settings, in order of use
const MOST_SHADES = small ? 6 : 24;

// Returns a canvas with the whole picture in its own pixels, null while it is being unpacked or where there is none.
function shade(frame, column, kind) {
  const key = `${frame}-${column}-${kind}`, setting = kind === "image" ? `${state.stops} ${state.curve}` : "";
  const found = shades.get(key);
  if (found?.setting === setting) {
    shades.delete(key);
    shades.set(key, found);
    return found.canvas;
  }
  const image = picture(frame, column, kind === "flip" ? "f" : "p", true);
  const target = kind === "relmse" ? picture(frame, REFERENCE, "p", true) : image;
  if (!image || !target || image.width !== target.width || image.height !== target.height) return null;
  const canvas = found?.canvas ?? element("canvas");
  if (canvas.width !== image.width || canvas.height !== image.height) {
    canvas.width = image.width;
    canvas.height = image.height;
  }
  const context = canvas.getContext("2d"), pixels = context.createImageData(image.width, image.height);
  const out = new Uint32Array(pixels.data.buffer);
  paint(image, column, target, kind, out);
  context.putImageData(pixels, 0, 0);
  shades.delete(key);
  shades.set(key, { canvas, setting });
  if (shades.size > MOST_SHADES) shades.delete(shades.keys().next().value);
  return canvas;
}

// A kind of picture that there is: error maps need a reference.
const kindOf = (frame, column, kind) => (kind === "image" || compared(frame, column) ? kind : "image");
