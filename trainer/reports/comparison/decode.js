// Reads the streams of coding.py. Runs in a worker; in the page itself where there are none.
"use strict";
const ALPHABET = "%ALPHABET%";
const LIMITS = %LIMITS%;
const LANES = %LANES%, ESCAPE = 255;

function bytesOf(text) {
  const values = new Uint8Array(128);
  for (let i = 0; i < 91; i++) values[ALPHABET.charCodeAt(i)] = i;
  const bytes = new Uint8Array(Math.floor(text.length / 2 * 13 / 8));
  let held = 0, bits = 0, out = 0;
  for (let i = 0; i + 1 < text.length; i += 2) {
    held |= (values[text.charCodeAt(i)] * 91 + values[text.charCodeAt(i + 1)]) << bits;
    bits += 13;
    while (bits >= 8) {
      bytes[out++] = held & 255;
      held >>>= 8;
      bits -= 8;
    }
  }
  return bytes;
}

function tablesOf(bytes, count) {
  const shares = new Uint16Array(count * 256), starts = new Uint16Array(count * 256);
  const symbols = new Uint8Array(count * 4096);
  let at = 0;
  for (let i = 0; i < bytes.length; i++) {
    const value = bytes[i];
    if (value === 0) at += bytes[++i];
    else shares[at++] = value < 192 ? value : ((value - 192) << 8) | bytes[++i];
  }
  for (let t = 0; t < count; t++) {
    for (let s = 0, sum = 0; s < 256; s++) {
      const share = shares[t * 256 + s];
      starts[t * 256 + s] = sum;
      symbols.fill(s, t * 4096 + sum, t * 4096 + sum + share);
      sum += share;
    }
  }
  return { shares, starts, symbols };
}

// Which table a difference of neighbours belongs to.
function contextsOf() {
  const contexts = new Uint8Array(LIMITS[LIMITS.length - 1] + 2);
  for (let a = 0, c = 0; a < contexts.length; a++) {
    while (c < LIMITS.length && a > LIMITS[c]) c++;
    contexts[a] = c;
  }
  return contexts;
}

function planesOf(text) {
  const bytes = bytesOf(text), view = new DataView(bytes.buffer);
  const [width, height, count, predictor, packed, escaped, coded] = [0, 1, 2, 3, 4, 5, 6].map((i) => view.getUint32(4 * i, true));
  const contexts = contextsOf(), most = contexts.length - 1, perPlane = LIMITS.length + 1;
  const { shares, starts, symbols } = tablesOf(bytes.subarray(28, 28 + packed), count * perPlane);
  let at = 28 + packed;
  const take = (Type, size, number) => new Type(bytes.slice(at, (at += size * number)).buffer);
  const escapes = take(Int32Array, 4, escaped), states = take(Uint32Array, 4, LANES), words = take(Uint16Array, 2, coded);
  const stride = width + 2, before = new Int32Array(width * height), planes = [];
  let lane = 0, word = 0, escape = 0;
  for (let p = 0; p < count; p++) {
    const plane = new Int32Array(stride * (height + 1));
    for (let y = 1; y <= height; y++) {
      const row = y * stride, up = row - stride;
      plane[row] = plane[up + 1];
      plane[up + width + 1] = plane[up + width];
      for (let x = 1; x <= width; x++) {
        const left = plane[row + x - 1], above = plane[up + x], corner = plane[up + x - 1];
        const place = (y - 1) * width + x - 1;
        const activity = Math.abs(left - corner) + Math.abs(above - corner) + Math.abs(plane[up + x + 1] - above) + 2 * before[place];
        const table = p * perPlane + contexts[activity > most ? most : activity];
        let state = states[lane];
        const slot = state & 4095, symbol = symbols[table * 4096 + slot], entry = table * 256 + symbol;
        state = shares[entry] * (state >>> 12) + slot - starts[entry];
        states[lane] = state < 65536 ? state * 65536 + words[word++] : state;
        if (++lane === LANES) lane = 0;
        const difference = symbol === ESCAPE ? escapes[escape++] : symbol & 1 ? (symbol + 1) >> 1 : -(symbol >> 1);
        let guess;
        if (predictor === 1) guess = (left + above) >> 1;
        else if (corner >= left && corner >= above) guess = left < above ? left : above;
        else if (corner <= left && corner <= above) guess = left > above ? left : above;
        else guess = left + above - corner;
        plane[row + x] = guess + difference;
        before[place] += difference < 0 ? -difference : difference;
      }
    }
    planes.push(plane);
  }
  return { width, height, planes };
}

// Returns levels: Int16Array of R, G, B per pixel and marks of what is not finite, or one number per pixel.
function decoded(text) {
  const { width, height, planes } = planesOf(text), stride = width + 2;
  const count = planes.length > 1 ? 3 : 1, levels = new Int16Array(width * height * count);
  const marks = planes.length > 3 ? new Uint8Array(width * height) : null;
  let largest = 0;
  for (let y = 0, i = 0; y < height; y++) {
    for (let x = 0; x < width; x++, i += count) {
      const at = (y + 1) * stride + x + 1, green = planes[0][at];
      if (count === 1) {
        levels[i] = green;
        continue;
      }
      const red = green + planes[1][at], blue = green + planes[2][at];
      levels[i] = red;
      levels[i + 1] = green;
      levels[i + 2] = blue;
      largest = Math.max(largest, red, -red, green, -green, blue, -blue);
      if (marks) marks[y * width + x] = planes[3][at];
    }
  }
  return { width, height, levels, marks, largest };
}

if (typeof document === "undefined") {
  self.onmessage = ({ data: { key, text } }) => {
    try {
      const image = decoded(text), kept = [image.levels.buffer];
      if (image.marks) kept.push(image.marks.buffer);
      self.postMessage({ key, image }, kept);
    } catch (error) {
      self.postMessage({ key, error: String(error) });
    }
  };
}
