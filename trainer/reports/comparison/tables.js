// Tables that sort, what is known of the methods, definitions.
let shownTable = null;
const sorting = { column: -1, down: false };

function buildTables() {
  const titled = (t) => t.title.replace(/, (higher|lower) is better$/, "");
  for (const [i, table] of facts.tables.entries()) $("table-name").append(element("option", { value: i }, titled(table)));
  $("table-name").addEventListener("change", () => showTable(facts.tables[$("table-name").value]));
  $("intervals").addEventListener("change", () => showTable(shownTable, true));
  if (facts.tables.length) showTable(facts.tables[0]);
  else {
    $("table").replaceChildren(element("p", {}, "Nothing could be measured: no frame has a reference."));
    $("table-name").disabled = $("intervals").disabled = true;
  }
}

function showTable(table, keep = false) {
  if (!keep) Object.assign(sorting, { column: -1, down: false });
  shownTable = table;
  if (!table) return;
  const heads = [table.corner, ...table.columns].map((text, i) => {
    const button = element("button", { type: "button", title: text }, text);
    button.addEventListener("click", () => {
      sorting.down = sorting.column === i ? !sorting.down : false;
      sorting.column = i;
      showTable(table, true);
      $("table").querySelectorAll("thead button")[i].focus();
    });
    const order = sorting.column === i ? (sorting.down ? "descending" : "ascending") : null;
    return element("th", { scope: "col", "aria-sort": order }, button);
  });
  const body = element("tbody", {}, ...ordered(table).map(([head, cells]) => rowOf(head, cells)));
  $("table").replaceChildren(element("table", {}, element("caption", { class: "hidden" }, table.title), element("thead", {}, element("tr", {}, ...heads)), body));
  $("table-notes").textContent = `${table.title}. ${table.notes.join(" ")}`;
}

function rowOf(head, cells) {
  const row = element("tr", head === "average" ? { class: "average" } : {}, element("th", { scope: "row", title: head }, head));
  for (const [mean, , rank, text, interval] of cells) {
    const cell = element("td", { class: ["", "best", "second"][rank] ?? "", "data-value": mean ?? "" }, text);
    if (interval && $("intervals").checked) cell.append(element("small", {}, `± ${interval}`));
    row.append(cell);
  }
  return row;
}

const numeric = (value) => (typeof value === "string" ? (value === "inf" ? Infinity : -Infinity) : value);
function ordered(table) {
  const rows = [...table.rows];
  if (sorting.column < 0) return rows;
  const last = rows.filter(([head]) => head === "average"), others = rows.filter(([head]) => head !== "average");
  const sign = sorting.down ? -1 : 1;
  others.sort((p, q) => {
    if (sorting.column === 0) return sign * p[0].localeCompare(q[0], undefined, { numeric: true });
    const [x, y] = [p, q].map((row) => numeric(row[1][sorting.column - 1][0]));
    if (x === null || y === null) return (x === null) - (y === null); // what is missing comes last
    return x === y ? 0 : sign * (x < y ? -1 : 1);
  });
  return [...others, ...last];
}

function buildMethods() {
  const heads = ["method", "", "class", "parameters", "s / Mpx", "GB / Mpx", "NaN, Inf pixels", "MLflow runs"];
  const rows = methods.map((m) => {
    const options = Object.entries(m.options ?? {}).map(([k, v]) => `${k}=${typeof v === "object" ? JSON.stringify(v) : v}`).join(", ");
    const status = element("td", { class: "text" }, element("span", { class: `status ${m.status}` }, m.status));
    if (m.reason) status.append(`: ${m.reason}`);
    const links = [["evaluation", m.run_url], ["training", m.training_url]].filter(([, url]) => url)
      .map(([text, url]) => element("a", { href: url, target: "_blank", rel: "noopener" }, text));
    const spread = m.cost?.spread ? element("small", {}, `${digits(m.cost.spread[0], 3)} to ${digits(m.cost.spread[1], 3)}`) : "";
    return element("tr", {},
      element("th", { scope: "row", title: m.model ?? m.label }, m.label), status,
      element("td", { class: "text" }, `${(m.class ?? "–").split(".").pop()}${options ? ` (${options})` : ""}`),
      element("td", {}, m.parameters === null || m.parameters === undefined ? "–" : m.parameters.toLocaleString("en")),
      element("td", {}, digits(m.cost?.seconds_per_megapixel ?? m.seconds, 3), spread),
      element("td", {}, m.cost?.peak_bytes_per_megapixel ? digits(m.cost.peak_bytes_per_megapixel / 1e9, 3) : "–"),
      element("td", {}, m.nonfinite ? m.nonfinite.toLocaleString("en") : "0"), element("td", { class: "links" }, ...(links.length ? links : ["–"])));
  });
  const header = element("thead", {}, element("tr", {}, ...heads.map((h, i) => element("th", { scope: "col", class: i === 1 || i === 2 ? "text" : "" }, h))));
  $("method-table").append(element("table", {}, header, element("tbody", {}, ...rows)));
  const measured = methods.find((m) => m.cost);
  const how = measured ? `Time and peak memory were measured apart, warm, on ${measured.cost.device}, ${measured.cost.threads} threads.` : "Time is the median over the frames of this evaluation.";
  $("method-table").after(element("p", { class: "faint note" }, how));
}

function buildDefinitions() {
  const error = `mean over R, G, B of (x − r)² / (r² + 0.01) of exposed radiance x and reference r, from the unpacked pictures, whose rounding alone adds about ${digits((2 * pictures.bound ** 2) / 3, 1)}; colours from 0.001 to 10 on a logarithmic scale.`;
  const list = [
    ...metrics.map((m) => [`${m.name} ${m.higher ? "↑" : "↓"}`, m.definition]),
    ["map relMSE", error],
    ["map FLIP", "LDR-FLIP (Andersson et al. 2020) at 67 pixels per degree of radiance at the frame's exposure, clipped to 1, from the files themselves; kept in steps of 1/64" + (pictures.block > 1 ? ` as means of ${pictures.block} × ${pictures.block} pixels.` : ".")],
    ["curves", "gamma 2.2: clamp(x^0.454545, 0, 1), as WSKP evaluates; sRGB: IEC 61966-2-1; sRGB(log(1+x)): the layer paper, Munkberg and Hasselgren 2020. All after the frame's exposure times 2^stops."],
    ["±", "half a 95 % confidence interval (Student's t) over frames with the scenes as they are."],
    ...Object.entries(facts.left_out),
  ];
  for (const [name, text] of list) $("metric-list").append(element("dt", {}, name), element("dd", {}, text || "–"));
}
