// What all sensors of a site say of one without a reference: on its card, in its view, and of the structure.
import { $, clean, get, make, placeOf, table } from "./common.js";
import { rounded, signed, two } from "./format.js";
import { card, copier } from "./parts.js";

const TOLD_PCT = 100, DEG = 180 / Math.PI, K = 2;
const when = (s) => [make("b", s.since), s.earliest !== s.since || s.latest !== s.since ? ` (between ${s.earliest} and ${s.latest})` : ""];
const sized = (s) => (s.turn ? `${rounded(Math.abs(DEG * s.size), DEG * s.expanded_uncertainty)}° (± ${rounded(DEG * s.expanded_uncertainty, DEG * s.expanded_uncertainty)}°)` : `${rounded(Math.abs(TOLD_PCT * s.size), TOLD_PCT * s.expanded_uncertainty)} % (± ${rounded(TOLD_PCT * s.expanded_uncertainty, TOLD_PCT * s.expanded_uncertainty)} %)`);
const ofAxes = (axes) => (axes === "xyz" ? "x, y and z" : axes);

function witness(w, turn) {
  const who = ["structure", "self-test"].includes(w.name) ? `the ${w.name}` : w.name, percent = (v) => TOLD_PCT * v;
  if (w.says === "silent") return `${who} is silent`;
  if (w.name === "noise") return `the noise has changed too (${signed(percent(w.size), percent(w.expanded_uncertainty))} %)`;
  if (w.says === "contradicts") return `${who} contradicts it${turn ? "" : ` (${signed(percent(w.size), percent(w.expanded_uncertainty))} % ± ${two(percent(w.expanded_uncertainty))} %)`}`;
  return `${who} says so (${two((K * Math.abs(w.size)) / w.expanded_uncertainty)} u)`;
}

// {say, more} of a sensor that is suspected.
export function suspectedWords({ suspected: s }) {
  const change = s.turn ? ["Turned about ", s.axes, " by ", make("b", sized(s))] : ["Sensitivity of ", ofAxes(s.axes), s.size < 0 ? " fell by " : " rose by ", make("b", sized(s))];
  const heard = s.witnesses.map((w) => witness(w, s.turn)).join(", "), says = (what) => s.witnesses.slice(1).some((w) => w.says === what), contradicted = says("contradicts"), agreed = says("agrees");
  return {
    say: ["Suspected: ", ...change, " since ", ...when(s), "."],
    more: [heard ? `${heard[0].toUpperCase()}${heard.slice(1)}. ` : "All sensors of its gateway have changed alike. ", s.one_of_two ? "Or that of the only other sensor has changed against it: which one is not seen. " : "", contradicted && !agreed ? "So rather the structure at the sensor, or its mount, has changed." : agreed && !contradicted ? "So the sensor itself has changed." : "The sensor has changed, or the structure at it moves otherwise in all bands alike."],
  };
}

// Of its values: S and Q in force stay, and U is enlarged by what is suspected.
export const suspectedUsable = ({ suspected: s }) => ["warn", [make("b", "Values of today may be used with a larger U"), s.u_pct === null ? ": of what is not known." : `: ± ${two(s.u_pct)} %, which holds the suspected change. `, "S and Q in force stay as they are. Values before ", s.earliest, " may be used with U as it was."]];

export const suspectedSteps = (row) => [make("p", `${row.suspected.turn ? "Look whether its mount has turned, then compare it with a reference" : "Compare it with a reference, and look at its mount"}, on gateway ${clean(`${row.site}/${row.gateway}`)}:`), copier(`fieldcal visit gateway.toml --data-dir visit --sensor ${clean(row.sensor)}`)];

// A card for a site of which the structure has changed.
export const structureCard = ({ site, what, since, earliest, latest }) => card({ kind: "structure", name: `site ${clean(site)}`, where: "all sensors together", say: ["The structure has changed: ", what, " since ", ...when({ since, earliest, latest }), "."], more: "No change of a sensitivity does so.", plot: null, steps: [make("p", "Look at the structure at these sensors. On a machine with the data of the monitor:"), copier("fieldcal fleet watch monitor/monitor.sqlite")] });

// The card of the view of a sensor: what the site says of it, or why it says nothing. `shown`: whether it still is shown.
export async function showSiteWatch(place, shown) {
  const told = await get(`api/watch?${new URLSearchParams({ site: place.get("site") })}`);
  if (!shown()) return;
  const one = told?.sensors.find((s) => placeOf({ ...s, site: place.get("site") }).toString() === place.toString());
  $("site-watch-card").hidden = !one;
  if (!one) return;
  const least = one.least_detectable_pct.map((v) => (v === null ? "not yet" : `${two(v)} %`)).join(", "), degc = one.temperature_range_degc;
  const rank = told.visit_order.indexOf(`${one.gateway}/${one.sensor}`) + 1;
  const rows = [
    ["Verdict", one.what ? `${one.verdict}: ${one.what}` : one.verdict], ["Until", told.until], ["Days", one.days],
    ["Least change", `${least} (x, y, z)`],
    ["Temperatures", degc[0] === null ? "none" : `${two(degc[0])} to ${two(degc[1])} °C${one.outside_temperature_range ? "; the last day was outside" : ""}`],
    ["Visit", rank ? `${rank} of ${told.visit_order.length}` : "none: it has a reference"],
  ];
  const visits = told.visits.filter((v) => v.sensor === `${one.gateway}/${one.sensor}`).map((v) => [v.date, v.suspicion, `${signed(v.found_pct, v.expanded_uncertainty_pct)} ± ${two(v.expanded_uncertainty_pct)} %`]);
  $("site-watch").replaceChildren(make("dl", rows.flatMap(([title, value]) => [make("dt", title), make("dd", value)]), { class: "facts" }), ...(visits.length ? [table("Visits", ["Visit", "Suspicion", "Change found"], visits)] : []), make("p", told.not_seen.join(" "), { class: "hint" }));
}
