// The fleet view: sensors with what needs a person on top, the plan of the structure, gateways; and the events view.
import { $, ago, at, make, placeOf, table, text, view } from "./common.js";
import { saveTable } from "./picture.js";

const ROWS_MAX = 500; // sensors that the table shows at once; the filters find the others
const HEALTH = ["silent", "degraded", "starting", "stopping", "", "running"];
const full = (r) => `${r.site}/${r.gateway}/${r.sensor}`;
const COLUMNS = [
  ["sensor", "Sensor", full],
  ["status", "Status", (r) => r.status],
  ["change", "Change in U", (r) => r.change_in_u ?? -1],
  ["age", "Last good window", (r) => -(r.last_good_utc_ns ?? 0)],
  ["gateway", "Gateway", (r) => HEALTH.indexOf(r.gateway_state)],
  ["why", "Why a person is needed", (r) => r.why],
];
const FIELDS = ["filter", "status", "health", "change", "age"];

function wanted(row, now) {
  const words = (now.get("filter") ?? "").toLowerCase(), status = now.get("status"), health = now.get("health");
  const change = Number(now.get("change")), age = Number(now.get("age"));
  return `${full(row)} ${row.status} ${row.why}`.toLowerCase().includes(words)
    && (!status || (status === "person" ? row.why !== "" : row.status === status))
    && (!health || row.gateway_state === health)
    && !(change > 0 && !((row.change_in_u ?? 0) >= change))
    && !(age > 0 && !(Date.now() / 1000 - (row.last_good_utc_ns ?? 0) / 1e9 >= age * 3600));
}

function rowOf(row, verifies) {
  return make("tr", [
    make("td", make("a", full(row), { href: `#${placeOf(row)}` })),
    make("td", row.status + (verifies && !row.verified ? " (not verified)" : "")),
    make("td", row.change_in_u === null ? "" : row.change_in_u.toFixed(1), { class: "number", "data-title": "change in U" }),
    make("td", ago(row.last_good_utc_ns), { class: "number", "data-title": "last good window" }),
    make("td", row.gateway_state || "on the bus", { class: "short", "data-title": "gateway" }),
    make("td", row.why, { class: "why" }),
  ]);
}

export function showFleet(told) {
  const now = view(), column = COLUMNS.find(([id]) => id === now.get("sort")), down = now.get("down") === "1";
  for (const name of FIELDS) if ($(name).value !== (now.get(name) ?? "")) $(name).value = now.get(name) ?? "";
  const rows = told.sensors.filter((row) => wanted(row, now));
  if (column) rows.sort((a, b) => (column[2](a) < column[2](b) ? -1 : column[2](a) > column[2](b) ? 1 : 0) * (down ? -1 : 1));
  COLUMNS.forEach(([id], i) => $("heads").children[i].setAttribute("aria-sort", now.get("sort") !== id ? "none" : down ? "descending" : "ascending"));
  const focused = $("rows").contains(document.activeElement) ? document.activeElement.getAttribute("href") : null;
  $("rows").replaceChildren(...rows.slice(0, ROWS_MAX).map((row) => rowOf(row, told.bus.verifies)));
  if (focused) [...$("rows").querySelectorAll("a")].find((link) => link.getAttribute("href") === focused)?.focus();
  $("more").replaceChildren(text(rows.length > ROWS_MAX ? `${rows.length - ROWS_MAX} more sensors; filter to see them` : ""));
  showPlan(told.plan, rows);
  $("gateways").replaceChildren(table("Gateways", ["Gateway", "On the bus", "State", "Sensors", "Version", "Why a person is needed"],
    told.gateways.slice(0, ROWS_MAX).map((g) => [`${g.site}/${g.gateway}`, g.alive ? "yes" : "no", g.state, g.sensors, g.version, make("span", g.why, { class: "why" })])));
}

// Sensors as points on the picture of the structure. Positions are fractions of its width and height.
function showPlan(plan, rows) {
  if (!plan) return;
  const points = rows.filter((row) => plan[full(row)]).map((row) => {
    const [x, y] = plan[full(row)], point = make("a", "", { href: `#${placeOf(row)}`, class: row.why ? "point alarm" : "point", title: `${full(row)}: ${row.why || row.status}`, "aria-label": `${full(row)}: ${row.why || row.status}` });
    point.style.left = `${100 * x}%`;
    point.style.top = `${100 * y}%`;
    return point;
  });
  const picture = $("plan").firstChild ?? make("img", [], { src: "plan", alt: "Plan of the structure" });
  $("plan").replaceChildren(picture, ...points);
}

export function showEvents(events) {
  $("event-rows").replaceChildren(table("Events, the newest first", ["UTC", "Sensor", "What", "Text"], events.map((e) => [
    at(e.t_utc_ns), make("a", full(e), { href: `#${placeOf(e)}` }), e.what, e.text])));
}

// `go` changes the view in the address.
export function startFleet(go) {
  $("heads").replaceChildren(...COLUMNS.map(([id, title]) => make("th", make("button", title, {
    type: "button", click: () => go({ sort: id, down: view().get("sort") === id && view().get("down") !== "1" ? "1" : "" }) }), { scope: "col" })));
  for (const status of ["VALID", "HELD", "INVALID", "RECALIBRATING", "COLLECTING", "UNCALIBRATED"]) $("status").append(make("option", status, { value: status }));
  for (const name of FIELDS) $(name).addEventListener("input", () => go({ [name]: $(name).value }));
  $("filters").addEventListener("submit", (event) => event.preventDefault());
  $("events-png").addEventListener("click", () => saveTable($("event-rows").querySelector("table"), "events.png"));
  $("fleet-png").addEventListener("click", () => saveTable($("sensors"), "fleet.png"));
}
