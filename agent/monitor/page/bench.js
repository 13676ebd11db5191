// The view of a session of `fieldcal bench`. It shows what the guide said, and computes nothing of its own.
import { $, clean, get, make, table, text, view } from "./common.js";
import { boxOf, descent } from "./plots.js";

const SILENT_S = 10; // the guide says the same again every two seconds
const AXES = ["x", "y", "z"];
const KINDS = [["main", "main_pct"], ["transverse", "transverse_pct"]];
const STAGES = { planning: "The program plans the positions.", measuring: "It measures: do not touch the table.", computing: "It computes." };
const ENDS = { valid: "The result is valid.", refused: "The result is refused.", "no result": "There is no result." };
const EMPTY = { stage: "", outlook: [], warnings: [], taken: [] };
const finite = (v) => typeof v === "number" && Number.isFinite(v);
const digits = (v, n) => (finite(v) ? Number(v.toPrecision(n)).toString() : "not known");
const percent = (u, key) => (u && finite(u[key]) ? `${digits(u[key], 2)} %` : "");
const both = (u) => KINDS.map(([kind, key]) => `${percent(u, key)} (${kind})`).join(", ");
const placeOf = (b) => new URLSearchParams({ site: b.site, gateway: b.gateway });
let shown = {}; // by the id of a part: what it was made of, so that only changes are drawn and read aloud

function put(id, from, content) {
  const key = JSON.stringify(from);
  if (shown[id] === key) return false;
  shown[id] = key;
  $(id).replaceChildren(...content(from));
  return true;
}

function now([stage, next, prompt, outlook]) {
  const lines = outlook.map((line) => make("p", line));
  if (prompt) lines.push(make("p", ["The program asks at the bench: ", make("strong", prompt)]));
  else if (STAGES[stage]) lines.push(make("p", STAGES[stage]));
  else if (stage === "ended") lines.push(make("p", "The session is over."));
  if (!next || stage === "computing") return lines;
  const more = next.more === null ? "" : next.more ? `; then about ${next.more} more stop${next.more > 1 ? "s" : ""} to what is wanted` : "; then it is as wanted";
  return [make("p", `Stop ${next.number}: ${next.told}`, { class: "told" }), make("p", `Why: it tells most of ${next.why}.`), make("p", `U will be ${both(next.after)}${more}.`), ...lines];
}

function stay([staying]) {
  if (!staying) return [];
  const bar = make("progress", [], { max: staying.most_s, value: Math.min(staying.stayed_s, staying.most_s), "aria-label": "time at this position" });
  const [stayed, least, most] = [staying.stayed_s, staying.least_s, staying.most_s].map((v) => digits(Math.round(v), 6));
  return [make("h3", `At ${staying.name}`), bar, make("p", `${stayed} s of ${least} to ${most} s; ${staying.expanded ? `U will be ${both(staying.expanded)}` : "no U yet"}`)];
}

function tables([place, expanded, next, taken, wanted]) {
  if (!wanted) return [];
  const reached = (key) => (expanded && expanded[key] <= wanted[key] ? "yes" : "no");
  const rows = KINDS.map(([kind, key]) => [kind, percent(expanded, key), percent(next?.after, key), percent(wanted, key), reached(key)]);
  const stops = taken.map((t, i) => [i + 1, t.name, percent(t.expanded, "main_pct"), percent(t.expanded, "transverse_pct")]);
  return [
    make("h3", "U (k = 2), apart from the reference's own error"), table("U so far", ["Of", "So far", "Next", "Wanted", "Met"], rows),
    make("h3", "Positions that are used"), table("Positions that are used", ["Stop", "Position", "U (main)", "U (transverse)"], stops), make("p", make("a", "CSV", { href: `bench.csv?${place}` })),
  ];
}

function warned([warnings]) {
  const lines = warnings.slice().reverse().map((w) => make("li", `Stop ${w.stop}: ${w.text}`));
  return lines.length ? [make("h3", "Warnings"), make("ul", lines, { class: "why" })] : [];
}

function ending([end]) {
  if (!end) return [];
  const rows = end.values.map((row, i) => [AXES[i], ...row]);
  const k = `± is U with k = ${digits(end.coverage_factor, 3)}; the error of the reference is in it.`, files = end.files.map((f) => [f.path, make("code", f.sha256)]);
  return [
    make("h3", "Result"), make("p", ENDS[end.status]), ...end.reasons.map((reason) => make("p", reason, { class: "why" })),
    ...(rows.length ? [table("S and Q with U", ["Axis", "Sx", "Sy", "Sz", "Q"], rows), make("p", k)] : []),
    ...(files.length ? [make("h3", "Result and certificate: files on the gateway"), table("Files", ["File", "SHA-256"], files)] : []),
  ];
}

function showGuide(guide, place) {
  put("bench-now", [guide.stage, guide.next, guide.prompt, guide.outlook], now);
  put("bench-stay", [guide.staying], stay);
  put("bench-warnings", [guide.warnings], warned);
  put("bench-end", [guide.ending], ending);
  put("bench-tables", [place, guide.expanded, guide.next, guide.taken, guide.wanted], tables);
  const some = guide.taken.length > 1; // one point is no curve
  if (put("bench-plot", [guide.taken, guide.wanted], () => (some ? [boxOf("U after each stop, as in the table above")] : [])) && some) descent($("bench-plot").firstChild, guide.taken, guide.wanted);
}

// Shows the session of the address, or the one that was heard last.
export async function show() {
  const given = view(), named = given.has("gateway"), is = (b) => b.site === given.get("site") && b.gateway === given.get("gateway");
  const { benches } = await get("api/bench"), chosen = named ? benches.find(is) : benches[0], place = chosen ? placeOf(chosen).toString() : "";
  const guide = chosen ? (await get(`api/bench?${place}`)).guide : null, others = benches.filter((b) => b !== chosen);
  put("bench-name", [chosen ? `Bench: ${chosen.site}/${chosen.gateway}/${clean(guide?.sensor)}` : "Bench"], ([name]) => [text(name)]);
  put("bench-others", [!chosen, others.map((b) => [b.site, b.gateway])], () => [
    ...(chosen ? [] : [text("No session is known. fieldcal bench is shown here while it runs and has a connection to the router. ")]),
    ...(others.length ? [text("Other sessions: ")] : []), ...others.flatMap((b) => [make("a", `${b.site}/${b.gateway}`, { href: `#view=bench&${placeOf(b)}` }), text(" ")])]);
  const silent = Boolean(chosen) && guide?.stage !== "ended" && chosen.age_s > SILENT_S;
  put("bench-silent", [silent], () => [text(silent ? "The program is silent: it has ended, or the network is cut." : "")]);
  showGuide(guide ?? EMPTY, place);
}

export function leave() {
  shown = {};
}
