// Mouse, fingers and keys on the large picture.
const fingers = new Map();
let pinch = null;

function onCanvas(event) {
  const box = canvas.getBoundingClientRect(), ratio = canvas.width / box.width;
  return { x: (event.clientX - box.left) * ratio, y: (event.clientY - box.top) * ratio };
}

canvas.addEventListener("pointerdown", (event) => {
  fingers.set(event.pointerId, onCanvas(event));
  canvas.setPointerCapture(event.pointerId);
  pinch = null;
  point(event);
});
canvas.addEventListener("pointermove", (event) => {
  const now = onCanvas(event), before = fingers.get(event.pointerId);
  if (before && fingers.size === 1) moveBy(now.x - before.x, now.y - before.y);
  if (before) fingers.set(event.pointerId, now);
  if (fingers.size === 2) pinched();
  point(event);
});
for (const kind of ["pointerup", "pointercancel"]) {
  canvas.addEventListener(kind, (event) => {
    fingers.delete(event.pointerId);
    pinch = null;
  });
}

function pinched() {
  const [p, q] = [...fingers.values()];
  const now = { x: (p.x + q.x) / 2, y: (p.y + q.y) / 2, apart: Math.max(1, Math.hypot(p.x - q.x, p.y - q.y)) };
  if (pinch) {
    zoomTo((scaleNow() * now.apart) / pinch.apart, now);
    moveBy(now.x - pinch.x, now.y - pinch.y);
  }
  pinch = now;
}

function point(event) {
  const { x, y } = onCanvas(event);
  state.pointer = pixelAt(x, y);
  draw();
}

canvas.addEventListener("wheel", (event) => {
  // Without a click before, the wheel scrolls the page.
  if (document.activeElement !== canvas && !event.ctrlKey && !event.metaKey) return;
  event.preventDefault();
  zoomTo(scaleNow() * Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.002)), onCanvas(event));
}, { passive: false });
canvas.addEventListener("dblclick", (event) => {
  const { x, y } = onCanvas(event);
  placeCrop(pixelAt(x, y));
});

const divider = $("divider");
function divide(share) {
  state.divider = Math.min(1, Math.max(0, share));
  divider.style.left = `${100 * state.divider}%`;
  divider.setAttribute("aria-valuenow", Math.round(100 * state.divider));
  draw();
}
divider.addEventListener("pointerdown", (event) => divider.setPointerCapture(event.pointerId));
divider.addEventListener("pointermove", (event) => {
  if (!divider.hasPointerCapture(event.pointerId)) return;
  const box = stage.getBoundingClientRect();
  divide((event.clientX - box.left) / box.width);
});
divider.addEventListener("keydown", (event) => {
  const step = { ArrowLeft: -0.02, ArrowRight: 0.02, PageDown: -0.1, PageUp: 0.1, Home: -1, End: 1 }[event.key];
  if (step === undefined) return;
  event.preventDefault();
  event.stopPropagation();
  divide(state.divider + step);
});

const inCanvas = { x: () => canvas.width / 2, y: () => canvas.height / 2 };
function keyed(event) {
  const step = 0.1 * canvas.width, kinds = ["image", "relmse", "flip"];
  const actions = {
    " ": takeTurns, s: () => setSplit(!state.split), c: () => placeCrop(pixelAt(inCanvas.x(), inCanvas.y())),
    m: () => setKind(kinds[(kinds.indexOf(state.kind) + 1) % 3]),
    "+": () => zoomTo(scaleNow() * 2), "=": () => zoomTo(scaleNow() * 2), "-": () => zoomTo(scaleNow() / 2), 0: fitAll,
    "[": () => expose(state.stops - 0.5), "]": () => expose(state.stops + 0.5), ",": () => turnFrame(-1), ".": () => turnFrame(1),
    ArrowLeft: () => (event.shiftKey ? moveBy(step, 0) : turnColumn(-1)), ArrowRight: () => (event.shiftKey ? moveBy(-step, 0) : turnColumn(1)),
  };
  if (event.shiftKey) Object.assign(actions, { ArrowUp: () => moveBy(0, step), ArrowDown: () => moveBy(0, -step) });
  const number = /^Digit([1-9])$/.exec(event.code ?? "")?.[1];
  if (number && columns[number - 1]) return () => (event.shiftKey ? setOther(number - 1) : setColumn(number - 1));
  return actions[event.key];
}

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest?.("select, input, textarea, table, summary, .scroll")) return;
  if (event.key === " " && event.target.closest?.("button, a")) return; // presses it
  const action = keyed(event);
  if (!action) return;
  event.preventDefault();
  action();
});
