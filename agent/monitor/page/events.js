// The events view: the newest changes of status, drift verdicts and commands.
import { $, full, get, make, placeOf, table } from "./common.js";
import { day, moment } from "./format.js";
import { saveTable } from "./picture.js";

export async function show() {
  const events = await get("api/events");
  const times = (e) => (e.count > 1 ? make("span", [`${e.count} times since `, day(e.first_utc_ns)]) : "once");
  $("event-rows").replaceChildren(table("Events, the newest first", ["When", "Sensor", "What", "Text", "How often"], events.map((e) => [
    moment(e.t_utc_ns), make("a", full(e), { href: `#${placeOf(e)}` }), e.what, e.text, times(e)])));
}

export function start() {
  $("events-png").addEventListener("click", () => saveTable($("event-rows").querySelector("table"), "events.png"));
}
