// The view of one sensor: what is said of it, S and Q over time, response, what makes U, events, history, commands.
import { $, clean, full, get, isUnheard, make, placeOf, table, text, view } from "./common.js";
import { opener, poseForm } from "./commands.js";
import { drawRows } from "./diagram.js";
import { ago, AXES, band, day, finite, MAIN, moment, NAMES, plusMinus, rounded, short, symbol, two } from "./format.js";
import { bars, chip, may } from "./parts.js";
import { savePlots } from "./picture.js";
import { boxOf, curves, TimePlots } from "./plots.js";
import { showSiteWatch } from "./site-watch.js";
import { cause, certificate, covered, explanation, shortName, steps, timeOf, told as toldOf, unjudged } from "./words.js";

const NEWEST = 100; // results of each kind that are asked for, beside the calibrations of the whole history
const KINDS = ["calibration", "window", "drift", "status", "estimate", "clock"];
const MARKS_MAX = 40;
const NOTHING = { sound: "Nothing: it is in order.", retired: "Nothing: it was taken down." };
const BUDGET_LEAST = 0.01; // share of a source that is shown by itself
const value = (c, i) => (i < 9 ? c.sensitivity[Math.floor(i / 3)][i % 3] : c.offset[i - 9]);
const ofAxis = (c, i) => value(c, i < 9 ? 4 * Math.floor(i / 3) : 4 * (i - 9)); // the main sensitivity of an output
let current = null; // {place, changed, plots}

const csv = (place, what) => make("p", make("a", "CSV", { href: `sensor.csv?${place}&what=${what}` }));
const newestFirst = (rows) => rows.slice().reverse();
const fold = (title, ...content) => make("details", [make("summary", make("h3", title)), ...content.flat()], { class: "card pad" });

// --- plots over time

// A series in % of the main sensitivity of its output since the calibration `from`; of an offset in m/s².
function seriesOf(calibrations, from, i, tone) {
  const unit = i < 9 ? 100 : 1, scale = from ? Math.abs(ofAxis(from, i)) : 0, base = from ? value(from, i) : 0;
  const part = (v) => (finite(v) && scale ? (unit * v) / scale : null);
  return { label: NAMES[i], tone, values: calibrations.map((c) => (finite(value(c, i)) ? part(value(c, i) - base) : null)), u: calibrations.map((c) => part(c.standard_uncertainty[i])) };
}

function marksOf(row, trends, whole, statuses) {
  const marks = [];
  for (const v of row?.verdicts ?? []) {
    const change = trends.found?.[v.parameter]?.change, t = (change?.onset_utc_ns ?? v.onset_utc_ns) / 1e9;
    marks.push({ t, alarm: true, text: `${clean(v.parameter)} ${(change?.shape ?? v.verdict) === "stepped" ? "steps" : "begins to drift"}` });
  }
  whole.forEach((c, k) => {
    const before = whole[k - 1];
    if (before && c.references?.at(-1) !== before.references?.at(-1)) marks.push({ t: c.t_utc_ns / 1e9, text: `reference ${clean(c.references?.at(-1))}` });
    if (before && c.made_sequence && !before.made_sequence) marks.push({ t: c.t_utc_ns / 1e9, text: "restart" });
  });
  for (const s of statuses) {
    if (/^(estimate \d+ accepted|rolled back|put on hold|released) by /.test(s.reason)) marks.push({ t: s.t_utc_ns / 1e9, text: "operator" });
    if (s.status === "RECALIBRATING" && s.before !== "RECALIBRATING") marks.push({ t: s.t_utc_ns / 1e9, text: "jump adopted", alarm: true });
  }
  return marks.slice(0, MARKS_MAX);
}

// The newest estimates of a sensor that is held, after its calibration in force.
function beyondOf(row, whole, estimates) {
  return row?.status === "HELD" ? estimates.map((e) => e.calibration).filter((c) => c.t_utc_ns > (whole.at(-1)?.t_utc_ns ?? 0)) : [];
}

// A series until today: what is in force stays so, also while windows contradict it; nobody knows it of a silent sensor.
function going({ values, u, ...rest }, more, stays) {
  const last = (all) => Array(more).fill(stays ? all.at(-1) ?? null : null);
  return { ...rest, values: [...values, ...last(values)], u: [...u, ...last(u)] };
}

function drawPlots(mine, row, trends, whole, found) {
  const from = whole.find((c) => c.t_utc_ns >= (trends.accepted_utc_ns ?? 0)) ?? whole[0], all = NAMES.map((_, i) => i);
  const beyond = beyondOf(row, whole, found.estimate), stays = row && !isUnheard(row) && row.kind !== "no data", today = row && !isUnheard(row) ? [timeOf(row)] : [];
  const times = [...whole, ...beyond].map((c) => c.t_utc_ns / 1e9).concat(whole.length ? today.map((ns) => ns / 1e9) : []), more = times.length - whole.length;
  const held = row?.status === "HELD" ? trends.held_utc_ns : null, refused = held ? found.window.filter((w) => !w.used && w.t_utc_ns >= held).map((w) => w.t_utc_ns / 1e9) : [];
  const marks = [...marksOf(row, trends, whole, found.status), ...(held ? [{ t: held / 1e9, text: "held", alarm: true }] : [])];
  const before = Array(whole.length).fill(null), after = today.map(() => null), round = ({ label, values, u, ...rest }) => ({ ...rest, label: `${label} est.`, dashed: true, values: [...before, ...values, ...after], u: [...before, ...u, ...after] });
  const plot = (title, which, unit, digit, height) => {
    const of = (calibrations) => which.map((i, k) => seriesOf(calibrations, from, i, AXES[which.length === 3 ? k : Math.floor(i / 3)]));
    return { title, unit, digit, height, marks: height > 200 ? marks : [], refused: height > 200 ? refused : [], series: [...of(whole).map((one) => going(one, more, stays)), ...(beyond.length && which.length === 3 ? of(beyond).map(round) : [])] };
  };
  const transverse = all.filter((i) => i < 9 && !MAIN.includes(i));
  mine.last = times.at(-1) ?? 0;
  $("main-title").replaceChildren("Main sensitivities, change since the ", text(trends.accepted ? "accepted" : "first"), " calibration of ", from ? day(from.t_utc_ns) : "");
  $("beyond").textContent = `${beyond.length ? "Dashed: estimates, not in force. " : ""}${refused.length ? "▴ at the lower edge: windows since then that were not used. " : ""}`;
  if (!mine.boxes) {
    mine.boxes = [boxOf(""), boxOf(""), boxOf("")];
    $("main-plot").replaceChildren(mine.boxes[0]);
    $("small-plots").replaceChildren(make("div", [make("h3", "Transverse, % of main"), mine.boxes[1]], { class: "card pad" }), make("div", [make("h3", "Offset Q, m/s²"), mine.boxes[2]], { class: "card pad" }), make("div", [make("h3", "Response over frequency"), make("div", "", { id: "response-plot" })], { class: "card pad" }));
  }
  if (times.length) mine.plots.draw(times, [[mine.boxes[0], plot("Main sensitivities", MAIN, " %", 0.01, 280)], [mine.boxes[1], plot("Transverse sensitivities", transverse, " %", 0.01, 170)], [mine.boxes[2], plot("Offset", [9, 10, 11], "", 0.001, 170)]]);
}

function drawResponse(newest) {
  const bands = newest?.response ?? [], place = $("response-plot");
  if (!bands.length) { place.replaceChildren(make("p", "The motion has no band that is wide enough to tell it.", { class: "hint" })); return; }
  const middle = bands.map((b) => Math.sqrt(Math.max(b.low_hz, 0.1 * b.high_hz) * b.high_hz));
  const part = (b, i) => [b.sensitivity_re[i][i], b.standard_uncertainty[i][i]].map((v) => (100 * v) / newest.sensitivity[i][i]);
  const series = AXES.map((axis, i) => ({ label: `S${axis}${axis}`, values: bands.map((b) => part(b, i)[0] - 100), u: bands.map((b) => part(b, i)[1]) }));
  const box = boxOf("Response over frequency: main sensitivities against the sensitivity in force, in %");
  place.replaceChildren(box);
  curves(box, "", middle, series, true, false, 170);
}

// --- what stands beside the plots

// k of a result; NaN where it tells none, as a result of a stranger may.
const coverageFactor = (newest) => (newest?.coverage_factor > 0 ? newest.coverage_factor : NaN);

function showMatrix(newest, row, trends) {
  $("matrix-title").replaceChildren(text(newest ? `S in force, ${clean(newest.output_unit)} per m/s²` : "S in force"));
  if (!newest) { $("matrix").replaceChildren(make("p", "No calibration is in force.")); return; }
  const moved = new Set((row?.verdicts ?? []).map((v) => v.parameter));
  const cell = (i) => {
    const U = coverageFactor(newest) * newest.standard_uncertainty[i], change = trends.changes?.[i], over = change && finite(change.change) && change.U > 0 ? `${(Math.abs(change.change) / change.U).toFixed(1)} U` : "", silent = over && Math.abs(change.change) > change.U && !moved.has(NAMES[i]);
    const known = newest.determined[i] ? [] : [make("small", "by the prior")];
    const stays = moved.has(NAMES[i]) && (row.status === "HELD" || over === "0.0 U"); // windows tell a change, and S in force stays
    return make("td", [rounded(value(newest, i), U), make("small", finite(U) ? `± ${rounded(U, U)}` : "U not known"), ...(stays ? [make("small", "not in force")] : over ? [make("small", `moved ${over}${silent ? `, ${unjudged(trends)[0]}` : ""}`, silent ? { title: unjudged(trends)[1] } : {})] : []), ...known], { class: moved.has(NAMES[i]) ? "moved" : "", title: NAMES[i] });
  };
  const rows = AXES.map((axis, r) => make("tr", [make("th", axis, { scope: "row" }), cell(3 * r), cell(3 * r + 1), cell(3 * r + 2)]));
  const head = make("tr", [make("th", "output", { scope: "col" }), ...AXES.map((axis) => make("th", `along ${axis}`, { scope: "col" }))]);
  const at = [`At ${two(newest.reference_frequency_hz)} Hz`, newest.valid_band_hz?.length === 2 ? `; right within U/3 from ${band(newest.valid_band_hz)}` : "", `. U with k = ${two(newest.coverage_factor)} below each value; “moved”: its change since the accepted calibration over U of that change (k = 2).`];
  $("matrix").replaceChildren(make("table", [make("caption", "S in force", { class: "hidden" }), make("thead", head), make("tbody", rows)], { class: "matrix" }),
    make("table", [make("caption", `Offset Q, ${clean(newest.output_unit)}`), make("tbody", make("tr", AXES.map((_, i) => cell(9 + i))))], { class: "matrix" }), make("p", at, { class: "hint" }));
}

function showBudget(newest, row, trends) {
  const sources = Object.entries(trends.budget ?? {}), of = row?.verdicts[0]?.parameter, k = Math.max(0, MAIN.map((i) => NAMES[i]).indexOf(of)), name = NAMES[MAIN[k]];
  const total = sources.reduce((sum, [, u]) => sum + u[k] ** 2, 0), scale = newest ? Math.abs(value(newest, MAIN[k])) : 0;
  $("budget-title").replaceChildren("What makes U of ", symbol(name), total > 0 && scale ? ` (${two((100 * coverageFactor(newest) * Math.sqrt(total)) / scale)} %)` : "");
  if (!(total > 0)) { $("budget").replaceChildren(make("p", ["The newest result does not say it. On the gateway: ", make("code", `fieldcal show --budget ${newest ? newest.sequence : "NUMBER"}`)], { class: "hint" })); return; }
  const shares = sources.map(([source, u]) => [source, u[k] ** 2 / total]).sort((a, b) => b[1] - a[1]), small = shares.filter(([, s]) => s < BUDGET_LEAST);
  const rest = small.length ? [[`${small.length} others`, small.reduce((sum, [, s]) => sum + s, 0)]] : [];
  $("budget").replaceChildren(bars([...shares.filter(([, s]) => s >= BUDGET_LEAST), ...rest]));
}

function certified(row, trends) {
  const age = row ? certificate(row, trends.certificate_utc_ns) : [];
  return age.length ? [["Certificate", make("span", [...(row.calibrated_utc_ns ? ["of ", day(row.calibrated_utc_ns), ", "] : []), ...age])]] : [];
}

function showDevice(row, newest, clocks, trends) {
  const clock = clocks.filter((c) => c.role === "sensor").at(-1), ppm = clock && 1e6 * (clock.rate_hz / clock.nominal_rate_hz - 1);
  const lines = [
    newest && ["Sensor", newest.identity], clock && ["Rate", `${short(clock.rate_hz)} Hz, clock ${two(ppm)} ppm`], clock && finite(clock.lag_s) && ["Lag", `${plusMinus(1000 * clock.lag_s, 2000 * clock.u_lag_s)} ms`],
    newest && finite(newest.temperature_low_degc) && ["Temperature", `${two(newest.temperature_low_degc)} to ${two(newest.temperature_high_degc)} °C calibrated, S and Q at ${short(newest.reference_temperature_degc)} °C`],
    newest && ["Reference", row?.reference ? shortName(row.reference) : "none"], ...certified(row, trends),
    row && ["Last good window", `${ago(row.last_good_utc_ns, timeOf(row))} ago`], newest && ["Result", newest.signed_by ? `signed with the key ${newest.signed_by}` : "not verified"],
  ].filter(Boolean);
  $("device").replaceChildren(make("dl", lines.flatMap(([title, told]) => [make("dt", title), make("dd", told)]), { class: "facts" }));
}

// The hypotheses about windows that stay held: the newest that the agent has told since they are.
function showHypotheses(row, statuses) {
  const told = statuses.slice(statuses.findLastIndex((s) => s.status !== "HELD") + 1).findLast((s) => explanation(s.reason)), why = row?.status === "HELD" && told ? explanation(told.reason) : null;
  $("hypotheses-card").hidden = !why;
  if (!why) return;
  const best = why.best ? [[make("span", cause(why.best)), why.least, why.none - why.least]] : [];
  const alike = why.alike.map((each) => [make("span", cause(each)), "as well", ""]);
  const fit = why.best && !why.fits ? "The best is not within what chance allows. " : !why.best ? "No known explanation fits better. " : "";
  $("hypotheses").replaceChildren(table("Explanations", ["Another…", "χ²", "smaller by"], [["none: no change", why.none, ""], ...best, ...alike]),
    make("p", [`Of ${why.held} held windows, told `, moment(told.t_utc_ns), `; χ² (chi-squared) is ${why.limit} at most if an explanation is right. ${fit}Those that differ by less than 10 are not told apart. The agent states no prior odds.`], { class: "hint" }));
}

// Each event once, with how often it was told; numbers that differ make no other event.
function showEvents(statuses, drifts, estimates) {
  const told = [...statuses.map((s) => [s.t_utc_ns, s.status, s.reason]), ...drifts.map((d) => [d.t_utc_ns, `${d.parameter} ${d.verdict}`, d.reason]), ...estimates.map((e) => [e.t_utc_ns, "estimate, not in force", e.reason])].sort((a, b) => b[0] - a[0]), once = new Map();
  for (const [t, what, reason] of told) {
    const key = `${what} ${String(reason).replace(/[-+]?[0-9][0-9.e+-]*/g, "")}`, same = once.get(key);
    once.set(key, same ? { ...same, first: t, count: same.count + 1 } : { t, first: t, what, reason, count: 1 });
  }
  const often = (e) => (e.count > 1 ? make("span", [`${e.count} times since `, day(e.first)]) : "once");
  $("sensor-events").replaceChildren(table("Events", ["When", "What", "Reason", "How often"], [...once.values()].map((e) => [moment(e.t), e.what, e.reason, often(e)])));
}

// --- what is folded below

function responseSection(newest) {
  const bands = newest?.response ?? [], k = coverageFactor(newest);
  const rows = bands.map((b) => [band([b.low_hz, b.high_hz]), ...AXES.map((_, i) => `${plusMinus(b.sensitivity_re[i][i], k * b.standard_uncertainty[i][i])}, imaginary ${rounded(b.sensitivity_im[i][i], k * b.standard_uncertainty[i][i])}`)]);
  return bands.length ? fold(`Response over frequency; S holds at ${short(newest.reference_frequency_hz)} Hz`, table("Response over frequency", ["Band", "Sxx", "Syy", "Szz"], rows)) : [];
}

function temperatureSection(last, whole, later) {
  const known = whole.filter((c) => finite(c.reference_temperature_degc));
  if (!known.length) return [];
  const box = boxOf("Temperature over time: of reference, and the range of the data");
  const keys = [["of reference", "reference_temperature_degc"], ["lowest", "temperature_low_degc"], ["highest", "temperature_high_degc"]];
  later.push(() => curves(box, "Temperature, °C", known.map((c) => c.t_utc_ns / 1e9), keys.map(([label, key]) => ({ label, values: known.map((c) => c[key]) })), false, true));
  const slopes = (last.offset_temperature ?? []).map((row, k) => `Q by temperature, order ${k + 1}: ${row.map(short).join(", ")} ${last.output_unit}/K${k ? `^${k + 1}` : ""}. `);
  return fold("Temperature", make("p", [`Q holds at ${short(last.reference_temperature_degc)} °C; data from ${short(last.temperature_low_degc)} to ${short(last.temperature_high_degc)} °C. `, ...slopes]), box);
}

function devicesSection(newest, clocks) {
  const devices = Object.values(Object.fromEntries(clocks.map((c) => [c.device, c])));
  const rows = devices.map((c) => [c.device, c.role, `${short(c.rate_hz)} of ${short(c.nominal_rate_hz)}`, finite(c.lag_s) ? plusMinus(1000 * c.lag_s, 2000 * c.u_lag_s) : "", two(1000 * c.jitter_s)]);
  const shared = (newest?.shared_errors ?? []).map((s) => [s.reference, s.serial_number, s.sensitivity.map(short).join(", "), s.certificate_sha256.slice(0, 16)]);
  return fold("Devices and certificates", make("p", newest ? `Sensor: ${newest.identity}. References: ${newest.references.join("; ") || "none"}.` : "No calibration yet."),
    ...(rows.length ? [table("Clocks of the devices", ["Device", "Role", "Rate, Hz", "Lag, ms (U)", "Jitter, ms"], rows)] : []),
    ...(shared.length ? [table("References", ["Reference", "Serial number", "Sensitivity by certificate", "SHA-256 of the certificate"], shared)] : []));
}

function spaceSection(newest, later) {
  if (!newest) return [];
  const canvas = make("canvas", [], { role: "img", "aria-label": "Rows of S in space; a row on its axis has no transverse sensitivity", class: "space" });
  later.push(() => drawRows(canvas, newest.sensitivity));
  return fold("Rows of S in space", canvas);
}

// The advice looks at the peers too, so it is asked for when it is opened.
function adviceSection(place) {
  const box = make("div", "is being computed"), rows = (advice) => advice.map((a) => [a.subject, a.interval_days === null ? "not yet" : `${two(a.interval_days)} days`, a.due_utc_ns ? day(a.due_utc_ns) : "", a.reason]);
  const section = fold("When to look again", make("p", "Interval in which a change stays within the limit with 95 %, from the history (control chart, ILAC-G24)."), box, make("p", make("a", "CSV", { href: `advice.csv?${place}` })));
  section.addEventListener("toggle", () => get(`api/advice?${place}`).then((advice) => box.replaceChildren(table("When to look again", ["Of", "Interval", "Due", "Reasoning"], rows(advice))), () => box.replaceChildren(text("not known"))), { once: true });
  return section;
}

function sections(place, found, whole, hours, later) {
  const gateway = `${place.get("site")}/${place.get("gateway")}`, sensor = place.get("sensor");
  const { calibration, window, drift, status, estimate, clock } = found, newest = calibration.at(-1);
  const order = (verb, sequence) => ({ gateway, sensor, verb, arguments: { sequence } });
  // Held is what was compared with the state, and may be used once further windows confirm it.
  const verdictOf = (w) => (w.used ? "used" : Object.hasOwn(w.numbers, "innovation_chi2") ? "held" : "refused");
  const numbers = (w) => Object.entries(w.numbers).map(([name, v]) => `${name} ${short(v)}`).join(", ");
  return [
    fold("History of calibrations", table("Calibrations", ["When", "Number", "Windows", "Method", "Roll back"], newestFirst(calibration).map((r, i) => [moment(r.t_utc_ns), r.sequence, r.windows, r.method, i === 0 ? "in force" : opener(`Roll back to ${r.sequence}`, order("rollback", r.sequence))])), csv(place, "calibration")),
    fold("Estimates that are not in force", table("Estimates", ["When", "Number", "Why not in force", "Accept"], newestFirst(estimate).map((r) => [moment(r.t_utc_ns), r.sequence, r.reason, opener(`Accept ${r.sequence}`, order("accept", r.sequence))])), csv(place, "estimate")),
    adviceSection(place), responseSection(newest), temperatureSection(newest, whole, later), spaceSection(newest, later),
    fold("Windows", table("Windows", ["When", "Position", "Verdict", "Reason", "Numbers"], newestFirst(window).map((r) => [moment(r.t_utc_ns), r.position, verdictOf(r), r.reason, numbers(r)])), csv(place, "window")),
    fold("Drift verdicts and status", csv(place, "drift"), csv(place, "status"), table("Drift", ["When", "Parameter", "Verdict", "Since", "Reason"], newestFirst(drift).map((r) => [moment(r.t_utc_ns), r.parameter, r.verdict, r.verdict === "stable" ? "" : moment(r.onset_utc_ns), r.reason]))),
    fold("Summarised hours", table("Summarised hours", ["Until", "Status", "Calibrations", "Estimates", "Windows used", "Windows not used", "Clock reports"], newestFirst(hours).map((r) => [moment(r.t_utc_ns), r.status, r.calibrations, r.estimates, r.windows_used, r.windows_refused, r.clocks])), make("p", make("a", "CSV", { href: `hours.csv?${place}` }))),
    devicesSection(newest, clock),
  ].flat();
}

// --- the view

function begin(place) {
  $("site-watch-card").hidden = true;
  const gateway = `${place.get("site")}/${place.get("gateway")}`, sensor = place.get("sensor");
  const hold = (given) => ({ gateway, sensor, verb: "hold", arguments: given });
  $("crumbs").replaceChildren(make("a", "Fleet", { href: "#" }), text(` / ${place.get("site")} / ${place.get("gateway")}`));
  $("actions").replaceChildren(make("a", "Live signal", { href: `#view=live&${place}`, class: "button" }), opener("Hold", hold({})), opener("Release", hold({ release: true })));
  $("commands").replaceChildren(fold("State a position", poseForm(gateway, sensor)));
  for (const id of ["main-plot", "small-plots", "details", "matrix", "budget", "device", "sensor-events"]) $(id).replaceChildren();
}

function showHead(row, place, trends) {
  const name = place.get("sensor");
  $("name").replaceChildren(text(name), ...(row ? [text(" "), chip(row.kind)] : []));
  const { say, more } = row ? toldOf(row, trends) : { say: "The monitor has no results of this sensor.", more: [] };
  $("state").replaceChildren(make("span", say));
  $("usable").replaceChildren(...(row ? [may(covered(row, trends))] : []));
  $("beside-state").replaceChildren(make("span", more));
  $("sensor-steps").replaceChildren(make("h3", "What to do:"), ...(row ? steps(row, trends) : []), ...(!row || NOTHING[row.kind] ? [make("p", row ? NOTHING[row.kind] : "Look at the names in the address.")] : []));
}

// The folded parts that a person has opened stay open.
function refold(made) {
  const open = new Set([...$("details").querySelectorAll("details[open] > summary")].map((summary) => summary.textContent));
  for (const part of made) if (open.has(part.querySelector("summary")?.textContent)) part.open = true;
  $("details").replaceChildren(...made);
}

// Shows the sensor of the address; asks for its results only when its row has changed. `go` changes the address.
export async function show(told, go) {
  const now = view(), place = new URLSearchParams(["site", "gateway", "sensor"].map((n) => [n, now.get(n) ?? ""]));
  const row = told.sensors.find((r) => placeOf(r).toString() === place.toString());
  if (current?.place !== place.toString()) {
    leave();
    begin(place);
    showHead(row, place, {});
    current = { place: place.toString(), changed: null, plots: new TimePlots((range) => go({ from: range?.[0].toFixed(0), to: range?.[1].toFixed(0), days: "" })) };
  }
  const mine = current, inHand = $("details").contains(document.activeElement) && document.activeElement.tagName !== "SUMMARY";
  if (mine.changed !== (row?.changed ?? 0) && !inHand) {
    mine.changed = row?.changed ?? 0;
    const name = row ? full(row) : "", [told2, whole, hours, ...results] = await Promise.all([get(`api/trends?${new URLSearchParams({ of: name })}`), get(`api/spread?${place}`), get(`api/hours?${place}&limit=${NEWEST}`), ...KINDS.map((what) => get(`api/history?${place}&what=${what}&limit=${NEWEST}`))]);
    if (current !== mine) return;
    const trends = told2[name] ?? {}, found = Object.fromEntries(KINDS.map((what, i) => [what, results[i]])), later = [], newest = found.calibration.at(-1);
    showHead(row, place, trends);
    drawPlots(mine, row, trends, whole, found);
    if (whole.length) drawResponse(newest);
    showMatrix(newest, row, trends);
    showBudget(newest, row, trends);
    showDevice(row, newest, found.clock, trends);
    showHypotheses(row, found.status);
    showSiteWatch(place, () => current === mine).catch(() => undefined); // the next change asks again
    showEvents(found.status, found.drift, found.estimate);
    refold(sections(place, found, whole, hours, later));
    for (const draw of later) draw();
  }
  const days = Number(now.get("days")), from = Number(now.get("from")), to = Number(now.get("to")), zoom = from > 0 && to > from;
  $("span").value = zoom ? "zoom" : now.get("days") ?? "";
  const range = zoom ? [from, to] : days > 0 ? [mine.last - 86400 * days, mine.last] : null;
  if (`${range}` !== `${mine.plots.range}`) mine.plots.setRange(range);
}

export function leave() {
  current = null;
}

const KEYS = { "+": [0.5, 0], "=": [0.5, 0], "-": [2, 0], ArrowLeft: [1, -0.25], ArrowRight: [1, 0.25], 0: [1e9, 0] };

export function start(go) {
  $("span").addEventListener("input", () => $("span").value !== "zoom" && go({ days: $("span").value, from: "", to: "" }));
  $("sensor-png").addEventListener("click", () => savePlots([...$("sensor").querySelectorAll(".plot")], $("name").textContent, "sensor.png"));
  $("main-plot").tabIndex = 0;
  $("main-plot").addEventListener("keydown", (event) => {
    if (!KEYS[event.key] || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    current?.plots.move(...KEYS[event.key]);
  });
}
