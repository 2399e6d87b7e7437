// Controls, and the first picture.
function setColumn(i) {
  if (i !== state.a) {
    if (!state.split) state.b = state.a;
    else if (i === state.b) state.b = state.a;
  }
  state.a = i;
  refresh();
}

function setOther(i) {
  if (i === state.a) state.a = state.b;
  state.b = i;
  refresh();
}

function takeTurns() {
  [state.a, state.b] = [state.b, state.a];
  refresh();
}

function turnColumn(step) {
  const there = [...columns.keys()].filter((i) => state.frame < 0 || has(state.frame, i));
  const at = there.indexOf(state.a);
  if (there.length) setColumn(there[(at + step + there.length) % there.length]);
}

function setSplit(on) {
  state.split = on;
  divide(state.divider);
  refresh();
}

function setKind(kind) {
  state.kind = kind;
  refresh();
}

function expose(stops) {
  state.stops = Math.max(-10, Math.min(10, Math.round(stops * 4) / 4));
  $("stops").value = state.stops;
  refresh();
}

function fitAll() {
  Object.assign(state, { zoom: null, x: 0.5, y: 0.5 });
  draw();
}

function setFrame(i) {
  const before = sizeOf();
  state.frame = i;
  const now = sizeOf();
  if (before.width !== now.width || before.height !== now.height) fitAll();
  state.pointer = null;
  for (const side of ["a", "b"]) if (i >= 0 && !has(i, state[side])) state[side] = [...columns.keys()].find((c) => has(i, c)) ?? 0;
  refresh();
}

function turnFrame(step) {
  const at = pictures.frames.indexOf(state.frame);
  if (at >= 0) setFrame(pictures.frames[(at + step + pictures.frames.length) % pictures.frames.length]);
}

function refresh() {
  const frame = frames[state.frame];
  for (const button of $("chips").children) {
    const i = Number(button.dataset.column);
    button.setAttribute("aria-pressed", i === state.a);
    button.classList.toggle("second", i === state.b && i !== state.a);
    button.disabled = state.frame >= 0 && !has(state.frame, i);
  }
  const maps = state.frame >= 0 && REFERENCE >= 0 && has(state.frame, REFERENCE);
  for (const button of $("kinds").children) {
    button.setAttribute("aria-pressed", button.dataset.kind === (maps ? state.kind : "image"));
    button.disabled = !maps && button.dataset.kind !== "image";
    button.title = button.disabled ? "error maps need a reference" : "m";
  }
  $("split").setAttribute("aria-pressed", state.split);
  divider.hidden = $("name-b").hidden = !state.split;
  const names = { a: $("name-a"), b: $("name-b") };
  for (const side of ["a", "b"]) names[side].textContent = columns[state[side]]?.label ?? "";
  $("stops-text").value = `${state.stops > 0 ? "+" : state.stops < 0 ? "−" : "±"}${Math.abs(state.stops)} stops`;
  $("other").value = state.b;
  if (frame) {
    stage.style.setProperty("--ratio", Math.max(0.75, frame.width / frame.height));
    canvas.setAttribute("aria-label", `${columns[state.a]?.label} of ${frame.name}, ${frame.width} × ${frame.height} pixels`);
    fillFrames(frame.scene);
  }
  $("stops").disabled = $("curve").disabled = maps && state.kind !== "image";
  colorBar(maps ? state.kind : "image");
  draw();
}

function fillFrames(scene) {
  $("scene").value = scene;
  const select = $("frame");
  if (select.dataset.scene !== scene) {
    select.dataset.scene = scene;
    select.replaceChildren(...pictures.frames.filter((i) => frames[i].scene === scene).map((i) => element("option", { value: i }, `${frames[i].index}${frames[i].spp ? `, ${frames[i].spp} spp` : ""}`)));
  }
  select.value = state.frame;
}

function colorBar(kind) {
  $("colorbar").hidden = kind === "image";
  if (kind === "image") return;
  const hex = (i) => `#${facts.colors.slice(6 * i, 6 * i + 6)}`;
  const strip = element("i");
  strip.style.background = `linear-gradient(90deg, ${[...Array(33).keys()].map((i) => hex(Math.min(255, i * 8))).join(", ")})`;
  const ticks = kind === "flip" ? ["0", "0.25", "0.5", "0.75", "1"] : ["≤ 0.001", "0.01", "0.1", "1", "≥ 10"];
  const title = kind === "flip" ? "LDR-FLIP" : "relMSE, ε = 0.01";
  $("colorbar").replaceChildren(title, strip, element("div", {}, ...ticks.map((t) => element("span", {}, t))));
}

function describe() {
  const scenes = new Set(frames.map((f) => f.scene)).size, plural = (n, word) => `${n} ${word}${n === 1 ? "" : "s"}`;
  const made = facts.created ? `, ${facts.created.slice(0, 16).replace("T", " ")}` : "";
  $("summary").textContent = `${facts.data.root}${facts.data.split ? `, ${facts.data.split} split` : ""}: ${plural(methods.length, "method")}, ${plural(frames.length, "frame")} of ${plural(scenes, "scene")}${made}`;
  if (facts.run_url) {
    $("summary").append(", ", element("a", { href: facts.run_url, target: "_blank", rel: "noopener" }, "MLflow run"));
  }
  document.title = `${facts.data.root}: comparison of denoisers`;
  $("foot").textContent = `Made by penumbra-denoise ${facts.penumbra ?? ""}. Everything is inside this file; nothing is loaded from elsewhere.`;
  const percent = (v) => `${+(100 * v).toPrecision(3)} %`;
  const less = frames.length - pictures.frames.length;
  $("exactness").textContent = pictures.frames.length
    ? `Pictures are kept with a bounded error so that the page stays small: each channel is off by at most ${percent(pictures.bound)} (${percent(pictures.loose)} in the noisy input) of its exposed value + 1/64. Radiance is as rendered; metrics and FLIP were taken from the files themselves.${less > 0 ? ` ${less} of ${plural(frames.length, "frame")} ${less === 1 ? "has" : "have"} no pictures here, chosen evenly from all scenes; tables and plots have all.` : ""} NaN and Inf are magenta.`
    : "This evaluation has no pictures.";
  for (const m of methods) if (m.status !== "done") trouble(`${m.label} ${m.status}: ${m.reason ?? "no reason was given"}`);
  if (REFERENCE < 0) trouble("No frame has a reference: there are no metrics and no error maps.");
}

function build() {
  for (const [i, column] of columns.entries()) {
    const key = i < 9 ? [element("kbd", {}, String(i + 1))] : [];
    const button = element("button", { type: "button", "data-column": i, title: column.label }, ...key, element("span", {}, column.label));
    button.addEventListener("click", (event) => (event.shiftKey ? setOther(i) : setColumn(i)));
    $("chips").append(button);
    $("other").append(element("option", { value: i }, column.label));
  }
  for (const scene of new Set(pictures.frames.map((i) => frames[i].scene))) $("scene").append(element("option", { value: scene }, scene));
  const clicks = {
    before: () => turnFrame(-1), after: () => turnFrame(1), split: () => setSplit(!state.split), flip: takeTurns,
    out: () => zoomTo(scaleNow() / 2), in: () => zoomTo(scaleNow() * 2), fit: fitAll, one: () => zoomTo(1),
    "crop-here": () => placeCrop(pixelAt(canvas.width / 2, canvas.height / 2)),
  };
  for (const [id, action] of Object.entries(clicks)) $(id).addEventListener("click", action);
  for (const button of $("kinds").children) button.addEventListener("click", () => setKind(button.dataset.kind));
  $("scene").addEventListener("change", () => setFrame(pictures.frames.find((i) => frames[i].scene === $("scene").value)));
  $("frame").addEventListener("change", () => setFrame(Number($("frame").value)));
  $("other").addEventListener("change", () => setOther(Number($("other").value)));
  $("stops").addEventListener("input", () => expose(Number($("stops").value)));
  $("stops").addEventListener("dblclick", () => expose(0));
  $("curve").addEventListener("change", () => {
    state.curve = $("curve").value;
    refresh();
  });
  $("crop-size").addEventListener("change", () => {
    state.crop.size = Number($("crop-size").value);
    draw();
  });
  $("crop-map").addEventListener("change", draw);
  new ResizeObserver(draw).observe(stage);
  // After a click the keys belong to the picture: space takes turns, and does not press the button again.
  for (const group of document.querySelectorAll("#chips, #kinds, .under")) {
    group.addEventListener("click", (event) => event.detail && event.target.closest("button") && canvas.focus({ preventScroll: true }));
  }
}

document.addEventListener("DOMContentLoaded", draw);
build();
buildTables();
buildMethods();
buildDefinitions();
buildPlots();
buildCrops();
describe();
// A method against the input says more than the input alone.
state.a = columns.findIndex((c) => c.kind === "method");
if (state.a < 0) state.a = 0;
state.b = REFERENCE >= 0 ? REFERENCE : 0;
setFrame(state.frame);
divide(0.5);
