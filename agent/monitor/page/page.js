"use strict";
// Every text of the bus passes `text`, which makes text nodes alone; no string is ever read as HTML.
const $ = (id) => document.getElementById(id);
const text = (value) => document.createTextNode(value === null || value === undefined ? "" : String(value));
function make(tag, children = [], attributes = {}) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  for (const child of [children].flat()) element.append(child instanceof Node ? child : text(child));
  return element;
}
const ago = (ns) => {
  if (!ns) return "never";
  const s = Math.max(0, Date.now() / 1000 - ns / 1e9);
  return s < 120 ? `${Math.round(s)} s` : s < 7200 ? `${Math.round(s / 60)} min` : s < 172800 ? `${Math.round(s / 3600)} h` : `${Math.round(s / 86400)} d`;
};
const COLUMNS = [
  ["sensor", "Sensor", (r) => `${r.site}/${r.gateway}/${r.sensor}`],
  ["status", "Status", (r) => r.status],
  ["change", "Change in U", (r) => r.change_in_u ?? -1],
  ["age", "Last good window", (r) => -(r.last_good_utc_ns ?? 0)],
  ["gateway", "Gateway", (r) => (r.alive ? 1 : 0)],
  ["why", "Why a person is needed", (r) => r.why],
];
const NAMES = ["S_xx", "S_xy", "S_xz", "S_yx", "S_yy", "S_yz", "S_zx", "S_zy", "S_zz", "Q_x", "Q_y", "Q_z"];
let sensors = [], verifies = false;
const view = () => new URLSearchParams(location.hash.slice(1));
function go(changes) {
  const next = view();
  for (const [name, value] of Object.entries(changes)) value ? next.set(name, value) : next.delete(name);
  history.replaceState(null, "", `#${next}`);
  show();
}
function place(row) {
  return new URLSearchParams({ site: row.site, gateway: row.gateway, sensor: row.sensor });
}
function showFleet() {
  const now = view(), column = COLUMNS.find(([id]) => id === now.get("sort")), down = now.get("down") === "1";
  const wanted = (now.get("filter") ?? "").toLowerCase();
  if ($("filter").value !== (now.get("filter") ?? "")) $("filter").value = now.get("filter") ?? "";
  let rows = sensors.filter((r) => `${r.site}/${r.gateway}/${r.sensor} ${r.status} ${r.why}`.toLowerCase().includes(wanted));
  if (column) rows.sort((a, b) => (column[2](a) < column[2](b) ? -1 : column[2](a) > column[2](b) ? 1 : 0) * (down ? -1 : 1));
  COLUMNS.forEach(([id], i) => $("heads").children[i].setAttribute("aria-sort", now.get("sort") !== id ? "none" : down ? "descending" : "ascending"));
  $("rows").replaceChildren(...rows.map((r) => make("tr", [
    make("td", make("a", `${r.site}/${r.gateway}/${r.sensor}`, { href: `#${place(r)}` })),
    make("td", r.status + (verifies && !r.verified ? " (not verified)" : "")),
    make("td", r.change_in_u === null ? "" : r.change_in_u.toFixed(1), { class: "number" }),
    make("td", ago(r.last_good_utc_ns), { class: "number" }),
    make("td", r.alive ? "on the bus" : "silent"),
    make("td", r.why, { class: "why" }),
  ])));
}
async function showSensor(now) {
  const names = new URLSearchParams(["site", "gateway", "sensor"].map((n) => [n, now.get(n) ?? ""]));
  const get = async (what) => (await fetch(`api/history?${names}&what=${what}`)).json();
  const [calibrations, windows, drifts, states] = await Promise.all(["calibration", "window", "drift", "status"].map(get));
  if (view().toString() !== now.toString()) return;
  $("name").replaceChildren(text(`${now.get("site")}/${now.get("gateway")}/${now.get("sensor")}`));
  $("plots").replaceChildren(...NAMES.map((name) => make("div", [], { role: "img", "aria-label": `${name} over time with its k = 2 band` })));
  const value = (c, i) => (i < 9 ? c.sensitivity[Math.floor(i / 3)][i % 3] : c.offset[i - 9]);
  const style = getComputedStyle(document.body).color;
  NAMES.forEach((name, i) => {
    const box = $("plots").children[i], shift = (k) => calibrations.map((c) => value(c, i) === null || c.standard_uncertainty[i] === null ? null : value(c, i) + k * c.standard_uncertainty[i]);
    const axis = { stroke: style, grid: { stroke: "#8884" }, ticks: { stroke: "#8884" } };
    new uPlot({
      title: `${name}, ${calibrations.at(-1)?.output_unit ?? ""}${i < 9 ? " per m/s²" : ""}`, width: box.clientWidth || 320, height: 200,
      axes: [axis, { ...axis, size: 70 }],
      series: [{}, { label: name, stroke: "#1a73e8", width: 2, points: { show: true } }, { label: "+U", stroke: "#1a73e888" }, { label: "-U", stroke: "#1a73e888" }],
      bands: [{ series: [2, 3], fill: "#1a73e833" }],
    }, [calibrations.map((c) => c.t_utc_ns / 1e9), shift(0), shift(2), shift(-2)], box);
  });
  const table = (title, what, heads, rows) => [
    make("h3", [title, " ", make("a", "CSV", { href: `sensor.csv?${names}&what=${what}` })]),
    make("div", make("table", [make("thead", make("tr", heads.map((h) => make("th", h, { scope: "col" })))),
      make("tbody", rows.slice(-100).reverse().map((r) => make("tr", r.map((c) => make("td", c)))))]), { class: "wide" }),
  ];
  const at = (r) => Math.abs(r.t_utc_ns) > 8e21 ? "no time" : new Date(r.t_utc_ns / 1e6).toISOString().slice(0, 19).replace("T", " ");
  $("tables").replaceChildren(
    ...table("Drift", "drift", ["UTC", "Parameter", "Verdict", "Reason"], drifts.map((r) => [at(r), r.parameter, r.verdict, r.reason])),
    ...table("Status", "status", ["UTC", "Status", "Reason"], states.map((r) => [at(r), r.status, r.reason])),
    ...table("Calibrations", "calibration", ["UTC", "Number", "Windows", "Temperature"], calibrations.map((r) => [at(r), r.sequence, r.windows, r.reference_temperature_degc ?? "not measured"])),
    ...table("Windows", "window", ["UTC", "Position", "Verdict", "Reason"], windows.map((r) => [at(r), r.position, r.used ? "used" : "refused", r.reason])));
}
function show() {
  const now = view(), one = now.has("sensor");
  $("fleet").hidden = one;
  $("sensor").hidden = !one;
  document.title = one ? `fieldcal: ${now.get("sensor")}` : "fieldcal: fleet";
  one ? showSensor(now) : showFleet();
}
let loading = false, again = false;
async function load() {
  if (loading) { again = true; return; }
  loading = true;
  try {
    const answer = await (await fetch("api/fleet")).json();
    sensors = answer.sensors;
    verifies = answer.bus.verifies;
    const need = sensors.filter((r) => r.why).length, refused = answer.gateways.filter((g) => g.refused);
    $("summary").replaceChildren(text([
      `${sensors.length} sensors, ${need} need a person`,
      `${answer.bus.unconfirmed} unconfirmed results`,
      verifies ? "signatures are verified" : "signatures are not verified (option --keys)",
      answer.bus.left_out ? `${answer.bus.left_out} results of names or numbers beyond the limits are not shown` : "",
      ...refused.map((g) => `${g.site}/${g.gateway}: ${g.why}`),
      answer.bus.fault,
    ].filter(Boolean).join("; ")));
    show();
  } catch { $("summary").replaceChildren(text("the monitor does not answer")); }
  loading = false;
  if (again) { again = false; setTimeout(load, 500); }
}
document.addEventListener("DOMContentLoaded", () => {
  $("heads").replaceChildren(...COLUMNS.map(([id, title]) => {
    const button = make("button", title, { type: "button" });
    button.addEventListener("click", () => go({ sort: id, down: view().get("sort") === id && view().get("down") !== "1" ? "1" : "" }));
    return make("th", button, { scope: "col" });
  }));
  $("filter").addEventListener("input", () => go({ filter: $("filter").value }));
  addEventListener("hashchange", show);
  const changes = new EventSource("api/changes");
  changes.onmessage = load;
  changes.onerror = () => $("summary").replaceChildren(text("the monitor does not answer"));
  load();
});
