// The fleet view: counts by kind, cards of what needs a person, all sensors by gateway, and the gateways.
import { $, clean, full, get, make, placeOf, table, text, view } from "./common.js";
import { ago, AXES, band, day, DAY_NS, finite, moment, now, signed, symbol, two } from "./format.js";
import { card, chip, KINDS, spark, tile } from "./parts.js";
import { saveTable } from "./picture.js";
import { structureCard } from "./site-watch.js";
import { cardPlot, certificate, covered, largest, ofDoubled, shortName, stateOf, steps, timeOf, told as toldOf, unjudged } from "./words.js";

const WORST = ["drifting", "held", "doubled", "changed", "no data", "structure", "suspected", "silent", "uncalibrated", "gateway"]; // the worst first
const LET_GO_MS = 600000; // after which nobody is taken to look at a page that was not touched, as on a wall
const CARDS = 5; // that are shown at once; more by a button
const SCALE_PCT = 1; // of the small plots of the table, all alike
const AGAIN_MS = 60000; // after which the histories of rows that are seen are asked for again
const ASKED = 25; // sensors in one question
const GATEWAYS_MAX = 500; // rows of the table of gateways
const WAIT_MS = 600; // for the histories of the first cards
// The columns of the table, in their order: {column, head}. page.css knows a column by its name (data-column). One with a
// `title` has no head on a phone: there the title stands before the number. `means` explains the head.
const COLUMNS = [
  { column: "name", head: "Sensor" },
  { column: "x", head: [symbol("Sxx"), ", a year, ± 1 %"] },
  { column: "y", head: symbol("Syy") },
  { column: "z", head: symbol("Szz") },
  {
    column: "change", head: "Largest change", title: "change", number: true,
    means: "The largest change of the three main sensitivities since the accepted calibration",
  },
  { column: "over", head: "Change over U", title: "of U", number: true },
  { column: "u", head: "U", title: "U", number: true },
  { column: "band", head: "Valid band", title: "band", number: true },
  { column: "good", head: "Last good window", title: "last good", number: true },
  { column: "reference", head: "Reference, age of certificate", title: "reference" },
];
let shownCards = CARDS, drawnFrom = null; // from when on cards and rows are drawn
const groups = new Map(); // by site/gateway: {element, body, rows, built, open}
const trends = new Map(); // by name: {at, told}; what the histories of seen sensors tell
const cards = new Map(); // by key: {element, from}
let order = null, orderFor = "", touchedAt = performance.now(); // keys of the cards that are shown, for which filter

const gatewayOf = (row) => `${row.site}/${row.gateway}`;
const put = (element, content) => { if (element.textContent !== content) element.replaceChildren(text(content)); };

function wanted(row, filter) {
  const words = `${full(row)} ${row.kind} ${row.reference} ${row.why}`.toLowerCase();
  return (!filter.kind || row.kind === filter.kind) && (!filter.words || words.includes(filter.words));
}

// --- counts

function showCounts(sensors, kind, go) {
  const count = (one) => sensors.filter((row) => row.kind === one).length;
  const kinds = ["sound", "drifting", "held", "silent", ...["changed", "suspected", "doubled", "no data", "uncalibrated", "retired"].filter(count)];
  const key = JSON.stringify([kinds.map(count), sensors.length, kind]);
  if ($("counts").dataset.key === key) return;
  const focused = [...$("counts").children].indexOf(document.activeElement);
  $("counts").dataset.key = key;
  $("counts").replaceChildren(tile("sensors", sensors.length, "", !kind, () => go({ kind: "" })),
    ...kinds.map((one) => tile(KINDS[one][0], count(one), count(one) ? KINDS[one][1] : "", kind === one, () => go({ kind: kind === one ? "" : one }))));
  $("counts").children[focused]?.focus();
}

// --- cards

// A card for each sensor, or for a gateway that is not on the bus or whose results are mixed with others; the worst first.
function needs(sensors, gateways) {
  const found = [], kindOf = (gateway) => (gateway.mixed_utc_ns ? "doubled" : "gateway");
  const byGateway = (row) => row.kind === "doubled" || (row.kind === "silent" && row.gateway_state === "silent");
  const add = (kind, key, size, need) => found.push({ key, rank: WORST.indexOf(kind), size, ...need });
  for (const row of sensors.filter((one) => WORST.includes(one.kind) && !byGateway(one))) {
    add(row.kind, full(row), row.size_in_u ?? row.suspected?.visit_information_nat ?? 0, { row });
  }
  const silent = Map.groupBy(sensors.filter((row) => row.kind === "silent" && byGateway(row)), gatewayOf);
  for (const [name, rows] of silent) {
    const oldest = rows.reduce((a, b) => ((b.last_good_utc_ns ?? 0) < (a.last_good_utc_ns ?? 0) ? b : a));
    add("silent", `gateway ${name}`, rows.length, { row: oldest, rows });
  }
  for (const gateway of gateways.filter((g) => g.why && g.alive)) {
    add(kindOf(gateway), `state ${gatewayOf(gateway)}`, 0, { gateway, kind: kindOf(gateway) });
  }
  for (const site of gateways.length ? latest?.sites ?? [] : []) add("structure", `site ${site.site}`, 0, { site });
  return found.sort((a, b) => a.rank - b.rank || b.size - a.size || (a.key < b.key ? -1 : 1));
}

// What is said of a gateway beside why.
const ofGateway = (kind) => (kind !== "doubled" ? { steps: [make("p", "The state of a gateway says what to do: see docs/operation.md.")] } : {
  usable: ["bad", [make("b", "Values of its sensors may not be used"), ": nobody knows whose calibration is shown."]], steps: ofDoubled(),
});

const gatewayCard = (gateway, kind) => card({
  kind, name: `gateway ${clean(gatewayOf(gateway))}`, where: `${gateway.sensors} sensors, version ${clean(gateway.version)}`,
  say: [`${gateway.why}.`, ...(gateway.mixed_utc_ns ? [" Noticed ", moment(gateway.mixed_utc_ns), "."] : [])],
  more: [], plot: null, ...ofGateway(kind),
});

// Of a gateway that is silent: `row` is its sensor that has been silent longest.
function silentCard(row, rows, { say, usable, steps }) {
  const moved = rows.filter((one) => one.verdicts.length).map((one) => one.sensor);
  const names = rows.slice(0, 6).map((one) => one.sensor).join(", ");
  return card({
    kind: "silent", name: `gateway ${gatewayOf(row)}`, where: `${rows.length} sensors: ${names}${rows.length > 6 ? ", …" : ""}`,
    say, usable, plot: null, steps,
    more: moved.length ? `Before it fell silent ${moved.slice(0, 6).join(", ")} had changed.` : "Before it fell silent no drift was found.",
  });
}

function drawn({ row, rows, gateway, kind, site }) {
  if (site) return structureCard(site);
  if (gateway) return gatewayCard(gateway, kind);
  const found = trends.get(full(row))?.told, { say, more } = toldOf(row, found), usable = covered(row, found);
  if (rows) return silentCard(row, rows, { say, usable, steps: steps(row, found) });
  const name = make("a", `${clean(row.gateway)} / ${clean(row.sensor)}`, { href: `#${placeOf(row)}` });
  const where = `${clean(row.site)}${row.reference ? `, reference ${clean(row.reference)}` : ""}`;
  return card({ kind: row.kind, name, where, say, usable, more, plot: cardPlot(row, found), steps: steps(row, found) });
}

// A card that comes, goes or moves would push what a person reads. So it is told beside the heading, and comes when it is
// asked for, when a person comes back to the page, or where nobody touches it.
const nobodyLooks = () => document.hidden || performance.now() - touchedAt > LET_GO_MS;

function showCards(sensors, gateways, filter) {
  const all = needs(sensors.filter((row) => wanted(row, filter)), filter.kind || filter.words ? [] : gateways);
  const known = new Map(all.map((need) => [need.key, need]));
  const best = all.slice(0, shownCards).map((need) => need.key), asked = JSON.stringify([filter, shownCards]);
  if (!order || asked !== orderFor || nobodyLooks()) {
    order = sensors.length ? best : null;
    orderFor = asked;
  }
  const keys = order ?? [], come = best.filter((key) => !keys.includes(key)).length;
  const over = keys.filter((key) => !known.has(key)).length;
  const differs = [come && `${come} new`, over && `${over} over`].filter(Boolean).join(", ");
  const odd = sensors.filter((row) => wanted(row, filter) && WORST.includes(row.kind)).length;
  const many = (count, what) => `${count} ${what}${count === 1 ? "" : "s"}`;
  put($("needs-count"), all.length ? `Needs a person: ${many(all.length, "thing")}, ${many(odd, "sensor")}` : "Nothing needs a person");
  $("new-cards").hidden = !differs && best[0] === keys[0];
  put($("new-cards"), differs ? `${differs}: show` : "Another is the worst: sort");
  for (const key of keys) {
    const need = known.get(key), before = cards.get(key);
    const at = trends.get(need?.row && full(need.row))?.at;
    const from = need && JSON.stringify([need.row?.changed, need.rows?.map((row) => row.changed), need.gateway, need.site, at]);
    if (before?.from === from || (before && inHand(before.element))) continue; // it is drawn anew when the person has let go of it
    if (!need) {
      before?.element.querySelector(".chip").replaceWith(chip("over"));
      if (before) before.from = from;
      continue;
    }
    const element = drawn(need);
    before?.element.replaceWith(element);
    cards.set(key, { element, from });
  }
  for (const [key, { element }] of cards) if (!keys.includes(key)) { element.remove(); cards.delete(key); }
  keys.filter((key) => cards.has(key)).forEach((key, i) => {
    const { element } = cards.get(key), there = $("cards").children[i];
    if (there !== element) $("cards").insertBefore(element, there ?? null);
  });
  $("more-cards").hidden = all.length <= shownCards;
  put($("more-cards"), `Show ${all.length - shownCards} more`);
  ask(keys.map((key) => known.get(key)).filter((need) => need?.row).map((need) => need.row));
}

// --- what the histories tell, asked for when a row is seen

const waiting = new Map();
let asking = false;

// What a history is asked for at once: another kind, or another verdict.
const stateOfRow = (row) => [row.kind, ...row.verdicts.map((v) => `${v.parameter} ${v.verdict}`)].join();

function ask(rows) {
  for (const row of rows) {
    const name = full(row), before = trends.get(name);
    const changed = before && before.changed !== row.changed && performance.now() - before.at > AGAIN_MS;
    if (!before || changed || before.state !== stateOfRow(row)) waiting.set(name, row);
  }
  if (!asking && waiting.size) { asking = true; setTimeout(answer, drawnFrom > performance.now() ? 0 : 30); }
}

async function answer() {
  const rows = [...waiting].slice(0, ASKED);
  for (const [name] of rows) waiting.delete(name);
  try {
    const found = await get(`api/trends?${new URLSearchParams(rows.map(([name]) => ["of", name]))}`);
    for (const [name, row] of rows) {
      trends.set(name, { at: performance.now(), changed: row.changed, state: stateOfRow(row), told: found[name] ?? {} });
    }
    for (const [name, row] of rows) groups.get(gatewayOf(row))?.built?.get(name)?.history(found[name] ?? {});
    if (drawnFrom > performance.now()) drawnFrom = 0;
    if (latest && (!drawnFrom || rows.some(([name]) => cards.has(name)))) show(latest, changing);
  } catch {
    // The next change asks again; the page says meanwhile that the monitor does not answer.
  }
  asking = false;
  if (waiting.size) ask([]);
}

// --- the table

const cellOf = ({ column, title, number, means }, role, content) => make("div", content, {
  role, class: number ? "number" : null, "data-column": column, "data-title": title ?? null,
  title: role === "columnheader" ? means ?? null : null,
});

// A row whose cells are updated in place, so that it is never rebuilt under a person's hands.
class Row {
  constructor(row) {
    this.cells = Object.fromEntries(COLUMNS.map((column) => [column.column, cellOf(column, "cell", "")]));
    this.kind = make("span");
    this.cells.name.append(this.kind, make("a", row.sensor, { href: `#${placeOf(row)}` }));
    this.element = make("div", Object.values(this.cells), { role: "row", class: "row" });
    this.update(row);
    const known = trends.get(full(row));
    if (known) this.history(known.told);
  }

  update(row) {
    if (this.shown !== row.kind) this.kind.replaceChildren(chip(row.kind));
    this.shown = row.kind;
    put(this.cells.u, finite(row.u_pct) ? `± ${two(row.u_pct)} %` : "");
    put(this.cells.band, band(row.band_hz));
    put(this.cells.good, ago(row.last_good_utc_ns, timeOf(row)));
    this.row = row;
    this.refer();
  }

  history(told) {
    this.known = told;
    if (!told.t_utc_ns) return;
    const from = now() - 366 * DAY_NS;
    AXES.forEach((axis, i) => {
      const curve = { t: told.t_utc_ns, v: told.main_pct[i], tone: axis };
      this.cells[axis].replaceChildren(spark(`S${axis}${axis} over a year`, [curve], [from, now(), -SCALE_PCT, SCALE_PCT]));
    });
    const most = largest(told), [why, words] = unjudged(told), allowed = most?.over > 1 && this.row.kind === "sound";
    put(this.cells.change, most ? `${signed(most.pct, most.U)} %` : "");
    const reason = allowed ? [make("small", why, { title: words })] : [];
    this.cells.over.replaceChildren(...(most ? [text(`${most.over.toFixed(1)} U`), ...reason] : []));
    this.refer();
  }

  refer() {
    const told = certificate(this.row, this.known?.certificate_utc_ns);
    const key = `${this.row.reference} ${told.map((part) => part.textContent ?? part).join("")}`;
    if (this.referred === key) return;
    this.referred = key;
    const age = told.length ? [make("span", [", ", ...told], { class: "hint" })] : [];
    this.cells.reference.replaceChildren(text(shortName(this.row.reference)), ...age);
    this.cells.reference.title = this.row.reference;
  }
}

const seen = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) {
    const group = groups.get(target.dataset.of);
    if (!group) continue;
    group.seen = isIntersecting;
    fill(group);
  }
}, { rootMargin: "400px" });

const selected = (element) => !getSelection().isCollapsed && element.contains(getSelection().anchorNode);
const inHand = (element) => element.contains(document.activeElement) || selected(element);

// Draws the rows of a group that is seen, and forgets those of one that is far away.
function fill(group) {
  if (group.seen && group.open) {
    group.built ??= new Map();
    const names = new Set(group.rows.map(full));
    for (const [name, row] of group.built) {
      if (!names.has(name)) { row.element.remove(); group.built.delete(name); }
    }
    group.rows.forEach((row, i) => {
      const name = full(row), built = group.built.get(name) ?? new Row(row), there = group.body.children[i];
      if (group.built.has(name)) built.update(row);
      group.built.set(name, built);
      if (there !== built.element) group.body.insertBefore(built.element, there ?? null);
    });
    ask(group.rows);
  } else if (group.built && !inHand(group.body)) {
    group.body.replaceChildren();
    group.built = null;
  }
}

function made(name) {
  const parts = [make("span", "", { class: "group-name" }), make("span", "", { class: "hint" })];
  const button = make("button", parts, { type: "button", "aria-expanded": "true" });
  const head = make("div", make("div", button, { role: "cell" }), { role: "row", class: "group-head" });
  const body = make("div", "", { role: "presentation", class: "rows" });
  const element = make("div", [head, body], { role: "rowgroup", class: "group" });
  const group = { element, button, body, rows: [], built: null, open: true, seen: false };
  body.dataset.of = name;
  button.addEventListener("click", () => {
    group.open = !group.open;
    button.setAttribute("aria-expanded", String(group.open));
    size(group);
    fill(group);
  });
  seen.observe(body);
  return group;
}

const size = (group) => group.body.style.setProperty("--rows", group.open ? group.rows.length : 0);

function showTable(sensors, gateways, filter) {
  const wantedRows = Map.groupBy(sensors.filter((row) => wanted(row, filter)), gatewayOf);
  const states = new Map(gateways.map((g) => [gatewayOf(g), g]));
  for (const [name, group] of groups) {
    if (wantedRows.has(name) || inHand(group.element)) continue;
    seen.unobserve(group.body);
    group.element.remove();
    groups.delete(name);
  }
  let last = null;
  for (const [name, rows] of wantedRows) {
    const group = groups.get(name) ?? made(name), many = group.rows.length !== rows.length;
    group.rows = rows;
    if (!groups.has(name)) last ? last.after(group.element) : $("groups").prepend(group.element);
    groups.set(name, group);
    last = group.element;
    if (many) size(group);
    put(group.button.children[0], `${rows[0].site} / ${rows[0].gateway}`);
    const state = states.get(name), shown = state?.alive ? stateOf(state) : state?.retired ? "retired" : "not on the bus";
    put(group.button.children[1], `${rows.length} sensor${rows.length > 1 ? "s" : ""}, ${shown}`);
    if (group.built || group.seen) fill(group);
  }
  $("sensors").setAttribute("aria-rowcount", String(sensors.length));
  put($("none"), wantedRows.size ? "" : "No sensor is like this.");
}

// --- the gateways

function showGateways(gateways) {
  const key = JSON.stringify(gateways);
  if ($("gateways").dataset.key === key || inHand($("gateways"))) return;
  const stateWords = (g) => (g.alive ? g.state : g.retired ? "retired" : "");
  const rows = gateways.slice(0, GATEWAYS_MAX).map((g) => [
    gatewayOf(g), g.alive ? "yes" : "no", stateWords(g), g.sensors, g.version, make("span", g.why, { class: "why" }),
  ]);
  $("gateways").dataset.key = key;
  $("gateways").replaceChildren(table("Gateways", ["Gateway", "On the bus", "State", "Sensors", "Version", "Why a person is needed"], rows));
}

// --- the view

// The first cards and rows come with the histories of the cards, so that no card grows under the eyes of who reads.
function waits(sensors, gateways, filter) {
  if (drawnFrom === null && sensors.length) {
    drawnFrom = performance.now() + WAIT_MS;
    const first = needs(sensors.filter((row) => wanted(row, filter)), gateways).slice(0, CARDS).filter((need) => need.row && !need.rows);
    if (!first.length) drawnFrom = 0;
    ask(first.map((need) => need.row));
    setTimeout(() => latest && show(latest, changing), WAIT_MS + 1);
  }
  $("fleet").classList.toggle("waits", drawnFrom > performance.now());
  return drawnFrom > performance.now();
}

let latest = null, changing = () => undefined;
const filterOf = () => ({ kind: view().get("kind") ?? "", words: (view().get("filter") ?? "").toLowerCase() });

export function show(told, go) {
  latest = told;
  changing = go;
  const filter = filterOf();
  if ($("filter").value !== (view().get("filter") ?? "")) $("filter").value = view().get("filter") ?? "";
  showCounts(told.sensors, filter.kind, go);
  if (waits(told.sensors, told.gateways, filter)) return;
  showCards(told.sensors, told.gateways, filter);
  showTable(told.sensors, told.gateways, filter);
  showGateways(told.gateways);
}

// A picture of the table: what is filtered, with the numbers that have been seen.
function picture() {
  const rows = [...$("groups").querySelectorAll(".row")].map((row) => [...row.children].map((cell) => make("td", cell.textContent)));
  const heads = [...$("heads").children].map((head) => make("th", head.textContent));
  saveTable(make("table", [make("tr", heads), ...rows.map((cells) => make("tr", cells))]), "fleet.png");
}

export const leave = () => { order = null; };

export function start() {
  $("heads").replaceChildren(...COLUMNS.map((column) => cellOf(column, "columnheader", column.head)));
  $("filter").addEventListener("input", () => changing({ filter: $("filter").value }));
  $("filters").addEventListener("submit", (event) => event.preventDefault());
  $("fleet-png").addEventListener("click", picture);
  $("more-cards").addEventListener("click", () => { shownCards += 20; show(latest, changing); });
  document.addEventListener("visibilitychange", leave);
  addEventListener("beforeprint", () => { for (const group of groups.values()) { group.seen = true; fill(group); } });
  $("new-cards").addEventListener("click", () => { order = null; show(latest, changing); });
  for (const name of ["pointerdown", "pointermove", "keydown", "wheel", "touchmove"]) {
    addEventListener(name, () => { touchedAt = performance.now(); }, { passive: true });
  }
  $("fold").addEventListener("click", () => {
    const open = [...groups.values()].some((group) => group.open);
    for (const group of groups.values()) if (group.open === open) group.button.click();
  });
}
