// Convergence over samples per pixel, and time against quality.
const SVG = "http://www.w3.org/2000/svg";
const [PW, PH, PL, PR, PT, PB] = [560, 320, 58, 16, 12, 44];

function drawn(tag, attributes, text) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

const colorOf = (label) => {
  const at = methods.findIndex((m) => m.label === label);
  return at < 0 ? "var(--faint)" : `var(--c${at % 8})`;
};
const short = (text, most = 26) => (text.length > most ? `${text.slice(0, most - 1)}…` : text);

// Round numbers for an axis; decades with 1, 2, 5 where it is logarithmic.
function ticksOf(low, high, logarithmic) {
  if (logarithmic) {
    const found = [], decades = Math.log10(high / low);
    for (let e = Math.floor(Math.log10(low)); e <= Math.ceil(Math.log10(high)); e++) {
      for (const m of decades > 3 ? [1] : [1, 2, 5]) found.push(m * 10 ** e);
    }
    return found.filter((t) => t >= low * 0.999 && t <= high * 1.001);
  }
  const raw = (high - low) / 5 || 1, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].find((m) => m * power >= raw) * power, found = [];
  for (let t = Math.ceil(low / step) * step; t <= high + step * 1e-6; t += step) found.push(+t.toPrecision(12));
  return found;
}

function axisOf(values, logarithmic) {
  let [low, high] = [Math.min(...values), Math.max(...values)];
  if (logarithmic) {
    [low, high] = low === high ? [low / 2, high * 2] : [low / 1.25, high * 1.25];
    return { low, high, logarithmic, at: (v) => Math.log(v / low) / Math.log(high / low) };
  }
  const margin = (high - low) * 0.07 || Math.abs(high) * 0.05 || 1;
  [low, high] = [low - margin, high + margin];
  return { low, high, logarithmic, at: (v) => (v - low) / (high - low) };
}

function frameOf(title, x, y, names, ticks = null) {
  const svg = drawn("svg", { viewBox: `0 0 ${PW} ${PH}`, role: "img", "aria-label": title });
  const px = (v) => PL + x.at(v) * (PW - PL - PR), py = (v) => PH - PB - y.at(v) * (PH - PT - PB);
  for (const t of ticksOf(y.low, y.high, y.logarithmic)) {
    svg.append(drawn("line", { class: "grid", x1: PL, x2: PW - PR, y1: py(t), y2: py(t) }));
    svg.append(drawn("text", { x: PL - 7, y: py(t) + 4, "text-anchor": "end" }, digits(t, 3)));
  }
  for (const t of ticks ?? ticksOf(x.low, x.high, x.logarithmic)) {
    svg.append(drawn("line", { class: "grid", x1: px(t), x2: px(t), y1: PT, y2: PH - PB }));
    svg.append(drawn("text", { x: px(t), y: PH - PB + 17, "text-anchor": "middle" }, digits(t, 3)));
  }
  svg.append(drawn("line", { class: "axis", x1: PL, x2: PW - PR, y1: PH - PB, y2: PH - PB }));
  svg.append(drawn("text", { x: (PL + PW - PR) / 2, y: PH - 8, "text-anchor": "middle" }, names[0]));
  const side = drawn("text", { x: 0, y: 0, "text-anchor": "middle", transform: `translate(13 ${(PT + PH - PB) / 2}) rotate(-90)` }, names[1]);
  svg.append(side);
  return { svg, px, py };
}

// An error spans decades where the largest is many times the smallest.
const wide = (metric, values) => !metric.higher && Math.min(...values) > 0 && Math.max(...values) / Math.min(...values) > 5;

function tableNamed(name) {
  return facts.tables.find((t) => t.name === name);
}

function convergence(metric) {
  const table = tableNamed(`spp_${metric.name}`);
  if (!table) return null;
  const counts = table.rows.map(([head]) => parseFloat(head));
  const lines = table.columns.map((label, c) => ({
    label, points: table.rows.map(([, cells], i) => ({ x: counts[i], y: cells[c][0], half: cells[c][1] ?? 0 })).filter((p, i) => typeof p.y === "number" && !table.rows[i][1][c][6]),
  })).filter((line) => line.points.length);
  const values = lines.flatMap((l) => l.points.map((p) => p.y));
  if (!values.length) return null;
  const logarithmic = wide(metric, values);
  const reach = logarithmic ? values : lines.flatMap((l) => l.points.flatMap((p) => [p.y - p.half, p.y + p.half]));
  const title = `${metric.name} over samples per pixel`;
  const plot = frameOf(title, axisOf(counts, true), axisOf(reach, logarithmic), ["samples per pixel", `${metric.name} ${metric.higher ? "↑" : "↓"}`], counts);
  for (const { label, points } of lines) {
    const color = colorOf(label), place = (p) => `${plot.px(p.x).toFixed(1)} ${plot.py(p.y).toFixed(1)}`;
    for (const p of points) if (p.half) plot.svg.append(bar(plot, p, color, logarithmic));
    plot.svg.append(drawn("path", { d: `M${points.map(place).join("L")}`, fill: "none", stroke: color, "stroke-width": 2, "stroke-dasharray": label === "input" ? "2 4" : "none" }));
    for (const p of points) plot.svg.append(dot(plot, p, color, `${label}: ${digits(p.y)} at ${p.x} spp`));
  }
  return figureOf(title, plot.svg, lines.map((l) => l.label));
}

function bar(plot, p, color, logarithmic) {
  const low = logarithmic ? Math.max(p.y - p.half, p.y / 100) : p.y - p.half;
  return drawn("line", { x1: plot.px(p.x), x2: plot.px(p.x), y1: plot.py(low), y2: plot.py(p.y + p.half), stroke: color, "stroke-width": 1.5, opacity: 0.6 });
}

function dot(plot, p, color, text) {
  const made = drawn("circle", { cx: plot.px(p.x), cy: plot.py(p.y), r: 4.5, fill: color });
  made.append(drawn("title", {}, text));
  return made;
}

function figureOf(title, svg, labels) {
  const figure = element("figure", {}, element("figcaption", {}, title));
  figure.append(svg);
  const legend = element("div", { class: "legend" });
  for (const label of labels) {
    const swatch = element("i", { class: "swatch" });
    swatch.style.background = colorOf(label);
    legend.append(element("span", {}, swatch, label));
  }
  figure.append(legend);
  return figure;
}

// Methods that no other one beats in both time and quality, fastest first.
function frontOf(points, higher) {
  const sorted = [...points].sort((p, q) => p.x - q.x || (higher ? q.y - p.y : p.y - q.y));
  const front = [];
  for (const p of sorted) if (!front.length || (higher ? p.y > front.at(-1).y : p.y < front.at(-1).y)) front.push(p);
  return front;
}

function timeAgainstQuality(metric, scene) {
  const table = tableNamed(`scenes_${metric.name}`), cells = table?.rows.find(([head]) => head === scene)?.[1];
  if (!cells) return null;
  const points = methods.map((m) => {
    const cell = cells[table.columns.indexOf(m.label)];
    return { label: m.label, x: m.cost?.seconds_per_megapixel ?? m.seconds, y: cell?.[0], half: cell?.[1] ?? 0, missing: cell?.[6] };
  }).filter((p) => p.x > 0 && typeof p.y === "number" && !p.missing); // means of fewer frames cannot be compared
  if (!points.length) return null;
  const values = points.map((p) => p.y), logarithmic = wide(metric, values);
  const reach = logarithmic ? values : points.flatMap((p) => [p.y - p.half, p.y + p.half]);
  const title = `Time against ${metric.name}, ${scene}; dashed: Pareto front`;
  const plot = frameOf(title, axisOf(points.map((p) => p.x), true), axisOf(reach, logarithmic), ["seconds per megapixel", `${metric.name} ${metric.higher ? "↑" : "↓"}`]);
  const front = frontOf(points, metric.higher);
  plot.svg.append(drawn("path", { class: "front", d: `M${front.map((p) => `${plot.px(p.x).toFixed(1)} ${plot.py(p.y).toFixed(1)}`).join("L")}` }));
  for (const p of points) {
    if (p.half) plot.svg.append(bar(plot, p, colorOf(p.label), logarithmic));
    plot.svg.append(dot(plot, p, colorOf(p.label), `${p.label}: ${digits(p.y)}, ${digits(p.x, 3)} s per megapixel`));
  }
  named(plot, points);
  return figureOf(title, plot.svg, points.map((p) => p.label));
}

// Names beside points, left of those near the right border, one below the other where they would overlap.
function named(plot, points) {
  const taken = [];
  for (const p of [...points].sort((a, b) => plot.py(a.y) - plot.py(b.y))) {
    const x = plot.px(p.x), left = x > PW * 0.66, text = short(p.label);
    let y = plot.py(p.y) + 4;
    while (taken.some((t) => Math.abs(t.y - y) < 14 && Math.abs(t.x - x) < 190)) y += 14;
    taken.push({ x, y });
    plot.svg.append(drawn("text", { class: "label", x: x + (left ? -9 : 9), y, "text-anchor": left ? "end" : "start" }, text));
  }
}

function buildPlots() {
  for (const metric of metrics) $("plot-metric").append(element("option", {}, metric.name));
  const table = facts.tables.find((t) => t.name.startsWith("scenes_"));
  for (const [head] of [...(table?.rows ?? [])].reverse()) $("plot-scene").append(element("option", {}, head));
  for (const id of ["plot-metric", "plot-scene"]) $(id).addEventListener("change", showPlots);
  showPlots();
}

function showPlots() {
  const metric = metrics.find((m) => m.name === $("plot-metric").value);
  const figures = metric ? [convergence(metric), timeAgainstQuality(metric, $("plot-scene").value)].filter(Boolean) : [];
  $("plot-area").replaceChildren(...(figures.length ? figures : [element("p", { class: "faint" }, "Nothing to plot: no frame has a reference.")]));
  $("plot-metric").disabled = $("plot-scene").disabled = !figures.length;
  draw();
}
