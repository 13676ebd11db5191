// Fills parts.html: all parts of the page (parts.js) with invented data, so that a change of page.css, parts.js or
// words.js is seen at once. No view uses it.
import { $, make, table } from "./common.js";
import { DAY_NS, NAMES, now, plusMinus, signed, two } from "./format.js";
import { bars, card, chip, KINDS, may, tile } from "./parts.js";
import { boxOf, TimePlots } from "./plots.js";
import { cardPlot, covered, steps, told } from "./words.js";

const N = 60, today = now(), t = Array.from({ length: N }, (_, k) => today - (N - 1 - k) * 5 * DAY_NS), long = t.slice(0, 48);
const noise = (k, seed) => 0.03 * Math.sin(12.9898 * (k + 1) * seed), S = 26000;
const drift = t.map((_, k) => Math.max(0, k - 12) * 0.05 + noise(k, 1)), calm = t.map((_, k) => noise(k, 3)), step = t.map((_, k) => (k > 50 ? -3.1 : 0) + noise(k, 2));

// A row of api/fleet, and what api/trends tells of its history.
const row = (sensor, more) => ({ site: "bridge", gateway: "span-2", sensor, kind: "sound", status: "VALID", status_utc_ns: t[1], reason: "", verdicts: [], u_pct: 0.42, u_axis: "Sxx", band_hz: [1, 18], reference: "B12 4711", calibration_utc_ns: today, last_good_utc_ns: today, heard_utc_ns: today, result_utc_ns: today, estimate: 12, estimate_utc_ns: today, ...more });
const verdict = (parameter, kind, k, change, rate) => ({ parameter, verdict: kind, change, u_change: 26, rate, u_rate: 0.2, onset_utc_ns: t[k], t_utc_ns: t[k + 8], first_utc_ns: t[k + 8], drifts: kind === "drifting", false_alarms_a_year: 0.1 });
const history = (main, more) => ({ t_utc_ns: t, main_pct: main, accepted: true, changes: NAMES.map((_, i) => ({ change: i === 8 ? 65 : 10, U: 26 })), beside: { count: 17, changed: 1 }, held_utc_ns: t[49], found: {}, ...more });
const found = (v, parameter, part, u, change, begun) => ({ [parameter]: { t_utc_ns: part, values: v.slice(0, part.length).map((pct) => S * (1 + pct / 100)), began_utc_ns: begun, u: part.map(() => (u * S) / 200), scale: S, change } });
const bent = (size, u_size) => ({ shape: "drifting", onset_utc_ns: t[12], u_onset_days: 3, size: (size * S) / 100, u_size: (u_size * S) / 200, rate: (size * S) / 23500, u_rate: (u_size * S) / 47000 });
const estimates = t.slice(55).map((ns) => ({ t_utc_ns: ns, main_pct: [0, -9, 0], values: NAMES.map((_, i) => (i === 4 ? 0.91 * S : 0)), u: NAMES.map(() => 0.005 * S) }));
const held = row("deck-03", { kind: "held", status: "HELD", status_utc_ns: t[49], reason: "the window contradicts the calibration; held until further windows confirm a jump", last_good_utc_ns: t[47], calibration_utc_ns: t[47] });
const INVENTED = [
  [row("deck-07", { kind: "drifting", verdicts: [verdict("Sxx", "drifting", 12, 300, 2)] }), history([drift, calm, calm], { found: found(drift, "Sxx", t, 0.5, bent(2.4, 0.5)) })],
  [row("deck-08", { kind: "drifting", u_pct: 3.7, u_axis: "Syy", verdicts: [verdict("Sxx", "drifting", 12, 300, 2)] }), history([drift, calm, calm], { found: found(drift, "Sxx", t, 3.7, bent(2.4, 3.7)) })],
  [row("deck-04", { kind: "changed", u_pct: 3.4, verdicts: [verdict("Szz", "stepped", 40, -806, null)] }), history([calm, calm, step], { adopted_utc_ns: t[51], found: found(step, "Szz", t, 3.4, null, [t[39], t[40]]) })],
  [{ ...held, verdicts: [verdict("Syy", "stepped", 49, -2340, null), verdict("Qy", "stepped", 49, 23400, null)] }, history([calm, calm, calm], { refused_utc_ns: t.slice(49), estimates, found: { ...found(calm, "Syy", long, 0.4, null, [t[47], t[49]]), ...found(calm, "Qy", long, 0.4, null, [t[47], t[49]]) } })],
  [held, history([calm, calm, calm].map((v) => v.slice(0, 48)), { t_utc_ns: long, refused_utc_ns: t.slice(49), estimates: [] })],
  [{ ...held, reason: "put on hold by anna" }, history([calm, calm, calm].map((v) => v.slice(0, 48)), { t_utc_ns: long, refused_utc_ns: [], estimates: [] })],
  [row("tower-1", { kind: "doubled" }), {}],
  [row("deck-05", { kind: "no data", status: "INVALID", status_utc_ns: t[50], reason: "deck-05 is lost: [Errno 121] Remote I/O error", last_good_utc_ns: t[47] }), history([calm, calm, calm].map((v) => v.slice(0, 48)), { t_utc_ns: long, held_utc_ns: t[50] })],
  [row("tower-4", { kind: "silent", gateway_state: "silent", last_good_utc_ns: t[50], result_utc_ns: t[50], heard_utc_ns: t[52] }), {}],
  [row("tower-2", { kind: "retired", gateway_state: "silent", last_good_utc_ns: t[50], result_utc_ns: t[50], heard_utc_ns: t[50] }), {}],
  [row("pier-2", { kind: "suspected", reference: "", verdicts: [], suspected: { axes: "x", turn: false, size: -0.011, expanded_uncertainty: 0.003, since: "2026-05-03", earliest: "2026-05-01", latest: "2026-05-05", u_pct: 2.3, witnesses: [{ name: "structure", says: "agrees", size: -0.011, expanded_uncertainty: 0.003 }, { name: "gravity", says: "silent", size: null, expanded_uncertainty: null }, { name: "noise", says: "silent", size: null, expanded_uncertainty: null }] } }), {}],
  [row("deck-09", { kind: "uncalibrated", status: "COLLECTING", reason: "Sxz, Syz are not determined", calibration_utc_ns: null, last_good_utc_ns: null }), {}],
];
const sound = [row("deck-01", {}), history([calm, calm, drift], {})];

$("chips").append(...Object.keys(KINDS).flatMap((kind) => [chip(kind), " "]));
$("counts").append(...[["sensors", 40, ""], ["in order", 35, "ok"], ["drifting", 1, "bad"], ["held", 2, "warn"], ["not heard", 4, "off"]].map(([title, count, tone], i) => tile(title, count, tone, i === 0, () => undefined)));
$("cards").append(...INVENTED.map(([one, trends]) => card({ kind: one.kind, name: `${one.gateway} / ${one.sensor}`, where: "", ...told(one, trends), usable: covered(one, trends), plot: trends.t_utc_ns ? cardPlot(one, trends) : null, steps: steps(one, trends) })));
$("sound").append(make("p", told(...sound).say, { class: "say" }), may(covered(...sound)), make("p", told(...sound).more, { class: "more" }));
const box = boxOf("");
$("plot").append(box);
new TimePlots(() => undefined).draw(t.map((ns) => ns / 1e9), [[box, { title: "Invented", unit: " %", digit: 0.01, height: 280, refused: t.slice(49).map((ns) => ns / 1e9), marks: [{ t: t[12] / 1e9, text: "Sxx begins to drift", alarm: true }, { t: t[30] / 1e9, text: "reference ref-B" }], series: [["Sxx", drift, "x"], ["Syy", step, "y"], ["Szz", calm, "z"], ["Szz est.", calm.map((v, k) => (k < 50 ? null : v + 1)), "z", true]].map(([label, values, tone, dashed]) => ({ label, values, tone, dashed, u: values.map(() => 0.06) })) }]]);
$("bars").append(bars([["reference sensitivity", 0.61], ["reference drift", 0.22], ["type A", 0.16], ["3 others", 0.01]]));
$("numbers").append(table("Numbers", ["Value", "U", "Shown"], [[27192.4321, 26.154], [0.01234567, 0.00099], [-0.00004, 0.01], [1234567.8, 12345], [1.5, null]].map(([v, U]) => [String(v), String(U), `${plusMinus(v, U)}; ${signed(v, U)}; ${two(v)}`])));
