// What the page knows, and its pictures: unpacked when they are wanted, forgotten when there are too many.
const $ = (id) => document.getElementById(id);
const facts = JSON.parse($("facts").textContent);
const { columns, frames, metrics, methods, pictures } = facts;
const present = new Set(pictures.keys);
const REFERENCE = columns.findIndex((c) => c.kind === "reference");
const small = matchMedia("(max-width: 700px)").matches;
const MOST_BYTES = (small ? 120 : 400) << 20; // of unpacked pictures

function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "class") made.className = value;
    else if (value !== null && value !== undefined) made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

function trouble(text) {
  if ([...$("troubles").children].some((card) => card.textContent === text)) return;
  $("troubles").append(element("p", { class: "card", role: "alert" }, text));
}

// The text of a picture; the page may still be coming in.
function textOf(key) {
  return new Promise((resolve, reject) => {
    const look = () => {
      const found = $(key), complete = document.readyState !== "loading";
      if (found && (complete || found.nextElementSibling)) resolve(found.textContent);
      else if (complete) reject(new Error(`the page was cut off: picture ${key} is missing`));
      else setTimeout(look, 30);
    };
    look();
  });
}

const asked = new Map();
let workers = [];
try {
  const address = URL.createObjectURL(new Blob([$("decoder").textContent], { type: "text/javascript" }));
  for (let i = 0; i < Math.min(3, navigator.hardwareConcurrency || 1); i++) workers.push(new Worker(address));
} catch {
  workers = [];
}
const idle = [...workers], queue = []; // keys, the most wanted first
for (const worker of workers) {
  worker.onmessage = ({ data }) => {
    settle(data.key, data.image, data.error);
    idle.push(worker);
    handOut();
  };
  worker.onerror = () => {
    workers = []; // some browsers allow none in local files
    queue.length = 0;
    for (const key of asked.keys()) unpackHere(key);
  };
}

function handOut() {
  while (workers.length && idle.length && queue.length) {
    const key = queue.shift(), worker = idle.pop();
    textOf(key).then((text) => worker.postMessage({ key, text }), (error) => {
      settle(key, null, error.message);
      idle.push(worker);
      handOut();
    });
  }
}

function unpackHere(key) {
  textOf(key).then((text) => settle(key, decoded(text))).catch((error) => settle(key, null, error.message));
}

function settle(key, image, error) {
  const waiting = asked.get(key);
  asked.delete(key);
  if (!waiting) return;
  if (error) waiting.reject(new Error(error));
  else waiting.resolve(image);
}

function unpacked(key, urgent) {
  return new Promise((resolve, reject) => {
    asked.set(key, { resolve, reject });
    if (!workers.length) return unpackHere(key);
    if (urgent) queue.unshift(key);
    else queue.push(key);
    handOut();
  });
}

function hurry(key) {
  const at = queue.indexOf(key);
  if (at > 0) queue.unshift(...queue.splice(at, 1));
}

const images = new Map(); // key → { image, bytes } in order of use, or a promise

// Returns the picture if it is there; otherwise asks for it, and draws again when it has come.
function picture(frame, column, kind, urgent = false) {
  const key = `${frame}-${column}${kind}`;
  const found = images.get(key);
  if (found?.image) {
    images.delete(key);
    images.set(key, found);
    return found.image;
  }
  if (found?.coming && urgent) hurry(key);
  if (!found && present.has(`${frame}-${column}`)) {
    const coming = unpacked(key, urgent).then((image) => {
      if (kind === "f" && pictures.block > 1) image = expanded(image, pictures.block, frames[frame]);
      images.set(key, { image, bytes: image.levels.byteLength });
      forget(key);
    }, (error) => {
      images.set(key, { image: null, bytes: 0, failed: true });
      trouble(`A picture cannot be shown: ${error.message}`);
    });
    images.set(key, { coming });
    coming.then(draw);
  }
  return null;
}

// A map of blocks as one of pixels.
function expanded(map, block, { width, height }) {
  const levels = new Int16Array(width * height);
  for (let y = 0, i = 0; y < height; y++) {
    const row = Math.floor(y / block) * map.width;
    for (let x = 0; x < width; x++, i++) levels[i] = map.levels[row + Math.floor(x / block)];
  }
  return { ...map, width, height, levels };
}

function forget(kept) {
  let bytes = 0;
  for (const entry of images.values()) bytes += entry.bytes || 0;
  for (const [key, entry] of images) {
    if (bytes <= MOST_BYTES) return;
    if (key === kept || !entry.image) continue;
    images.delete(key);
    bytes -= entry.bytes;
  }
}

const waiting = () => [...images.values()].some((entry) => entry.coming);
const has = (frame, column) => present.has(`${frame}-${column}`);
const compared = (frame, column) => column !== REFERENCE && REFERENCE >= 0 && has(frame, REFERENCE) && has(frame, column);
