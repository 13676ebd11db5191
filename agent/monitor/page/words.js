// What is said of a sensor: its verdicts in sentences, what else is steady, and what a person can do.
import { commandLine } from "./commands.js";
import { clean, isUnheard, make } from "./common.js";
import { ago, AXES, band, day, DAY_NS, duration, finite, MAIN, moment, NAMES, now, rounded, short, signed, symbol, two } from "./format.js";
import { copier, spark } from "./parts.js";
import { suspectedSteps, suspectedUsable, suspectedWords } from "./site-watch.js";

const LEAST_PCT = 0.2; // half the range of a small plot at least, so that noise is not made large
const MONTH_DAYS = 30.44, YEAR_DAYS = 365.25;
const GATEWAY = "/etc/fieldcal/gateway.toml --data-dir /var/lib/fieldcal";
export const toneOf = (parameter) => AXES.at(Math.max(0, AXES.indexOf(parameter[1])));

// A size in % of the main sensitivity of its output; of an offset in m/s².
function scaled(parameter, scale) {
  const known = finite(scale) && scale !== 0, offset = parameter[0] === "Q";
  return { unit: !known ? "" : offset ? " m/s²" : " %", factor: !known ? 1 : (offset ? 1 : 100) / Math.abs(scale) };
}

const named = (parameter) => [parameter[0] === "Q" ? "offset " : "sensitivity ", symbol(parameter)];
const spread = (days) => (finite(days) ? ` (± ${duration(2 * days * DAY_NS)})` : "");

// A size with its U. Where U is larger, the change is found all the same (by the verdict), so it has this direction.
function pair(v, U, unit) {
  const size = Math.abs(v), range = U > size ? `0 to ${rounded(size + U, U)}` : `± ${rounded(U, U)}`;
  return [make("b", `${rounded(size, U)}${unit}`), finite(U) ? ` (${range}${unit})` : ""];
}

// Between which times a change began (agent.monitor.trends): values are uncertain from the first one on.
const beganOf = (verdict, trend) => trend?.began_utc_ns ?? [verdict.onset_utc_ns, verdict.onset_utc_ns];
const between = ([from, to]) => (day(from).textContent === day(to).textContent ? ["on ", day(to)] : ["between ", day(from), " and ", day(to)]);

// A verdict with its numbers: those of the history where it shows the change, else its own.
function finding(verdict, trend) {
  const own = { size: verdict.change, u_size: verdict.u_change ?? NaN, rate: verdict.rate, u_rate: verdict.u_rate ?? NaN, onset_utc_ns: verdict.onset_utc_ns };
  return { ...own, ...trend?.change, parameter: verdict.parameter, shape: trend?.change?.shape ?? verdict.verdict, began: beganOf(verdict, trend), told_utc_ns: trend?.change ? null : verdict.t_utc_ns, ...scaled(verdict.parameter, trend?.scale) };
}

// What has changed and by how much: "sensitivity Sxx fell by 3.1 % (± 0.2 %)".
function moved({ parameter, shape, size, u_size, rate, u_rate, unit, factor }) {
  const by = pair(size * factor, 2 * u_size * factor, unit), down = size < 0;
  if (shape === "stepped") return [...named(parameter), down ? " fell by " : " rose by ", ...by];
  const [days, name] = Math.abs(rate * factor * MONTH_DAYS) < 0.1 ? [YEAR_DAYS, "year"] : [MONTH_DAYS, "month"];
  return [...named(parameter), down ? " falls by " : " rises by ", ...pair(rate * factor * days, 2 * u_rate * factor * days, unit), ` a ${name}, `, ...by];
}

// A sentence for changes of one shape that began in the same time; with the date of the verdict where the history shows none.
function sentence([first, ...rest]) {
  const steps = first.shape === "stepped", [word, ...more] = moved(first), others = rest.flatMap((one, k) => [k ? ", " : ", and with it ", ...moved(one), steps ? "" : " so far"]);
  const since = steps ? [] : [" since ", day(first.onset_utc_ns), spread(first.u_onset_days)], when = steps ? [rest.length ? ", " : " ", "at once, ", ...between(first.began)] : [];
  return [word[0].toUpperCase() + word.slice(1), ...more, ...since, ...others, ...when, ...(steps || !first.told_utc_ns ? [] : ["; told on ", day(first.told_utc_ns)]), "."];
}

// What the verdicts of a sensor tell: a sentence for each cause that there may be, the largest change first. Changes that
// begin in the same time, as of S and Q of one output, have one cause more likely than two.
function findings(row, trends) {
  const causes = [];
  for (const one of row.verdicts.map((v) => finding(v, trends?.found?.[v.parameter]))) {
    const same = causes.find(([first]) => first.shape === one.shape && first.began[0] <= one.began[1] && one.began[0] <= first.began[1]);
    same ? same.push(one) : causes.push([one]);
  }
  return causes.map(sentence);
}
const inTurn = (sentences) => sentences.flatMap((one, k) => (k ? [" ", ...one] : one));

// Whether the values that a sensor measures, corrected with S and Q in force, may be used: [tone, sentence]. By status,
// verdicts and hearing alone; U is that of the calibration in force, and holds while windows fit it.
export function covered(row, trends) {
  const U = finite(row.u_pct) ? [`U = ± ${two(row.u_pct)} %`, ...(row.u_axis ? [" (", symbol(row.u_axis), ")"] : []), row.band_hz?.length === 2 ? ` at ${band(row.band_hz)}` : ""] : ["U is not known"];
  const good = row.last_good_utc_ns, held = trends?.held_utc_ns ?? row.status_utc_ns, last = good && (row.status !== "HELD" || good < held) ? good : held;
  const until = good ? ["Values until the last window that fitted (", day(last), ") may be used: ", ...U, ". "] : [];
  if (row.kind === "uncalibrated" || !row.calibration_utc_ns) return ["off", [make("b", "Values may not be used yet"), ": no calibration is in force."]];
  if (row.kind === "doubled") return ["bad", [make("b", "Values may not be used"), ": two gateways have this name, and nobody knows whose calibration is shown."]];
  if (isUnheard(row)) return ["off", [...until, make("b", "Of later values nobody knows"), "."]];
  if (row.kind === "no data") return ["bad", [...until, make("b", "Later values may not be used"), ": no window has confirmed them."]];
  if (row.status === "HELD") {
    const hold = ON_HOLD.test(row.reason);
    return [hold ? "warn" : "bad", [make("b", ["Values since ", day(last), hold ? " are not checked" : " may not be used"]), hold ? ": an operator put the calibration on hold. " : ": windows contradict S and Q in force, and U does not cover it. ", ...(good ? ["Earlier ones may: ", ...U, "."] : [])]];
  }
  const changes = row.verdicts.map((v) => [beganOf(v, trends?.found?.[v.parameter])[0], v.first_utc_ns]), from = Math.min(...changes.map(([begun]) => begun)), told = Math.max(...changes.map(([, at]) => at)), followed = Math.max(told, trends?.adopted_utc_ns ?? 0);
  if (changes.length && row.calibration_utc_ns < told) return ["bad", [make("b", ["Values since ", day(from), " may not be used"]), ": S and Q in force are of ", day(row.calibration_utc_ns), " and do not follow the change. Earlier ones may: ", ...U, "."]];
  if (row.kind === "suspected") return suspectedUsable(row);
  const old = timeOf(row) - row.calibration_utc_ns > DAY_NS ? [" (of ", day(row.calibration_utc_ns), ")"] : [];
  const late = changes.length ? ["; S and Q follow the change. Values of ", day(from), " to ", day(followed), ", before they did, may be wrong by it"] : [];
  return ["ok", [make("b", "Values of today may be used"), ": ", ...U, ...old, ...late, "."]];
}

// How sure the first verdict is, and its size where that is less sure.
function often(row, trends) {
  const [verdict] = row.verdicts, { size, u_size, unit, factor } = finding(verdict, trends?.found?.[verdict.parameter]), years = 1 / verdict.false_alarms_a_year, U = 2 * u_size * factor;
  const told = finite(years) && years > 0 ? `A sound sensor gives such a false alarm once in ${two(years)} years at most. ` : "";
  return U > Math.abs(size * factor) ? `${told}How far it has changed is less sure: U of the change is ± ${rounded(U, U)}${unit}. ` : told;
}

function steady(row) {
  const moved = new Set(row.verdicts.map((v) => v.parameter)), main = MAIN.map((i) => NAMES[i]).filter((name) => !moved.has(name));
  const offset = ["Qx", "Qy", "Qz"].some((name) => moved.has(name)) ? [] : ["Q"];
  const names = [...main.map(symbol), ...offset];
  return names.length ? ["Steady: ", ...names.flatMap((name, i) => (i ? [", ", name] : [name])), ". "] : [];
}

// What the other sensors with the same reference say of it.
const clearsReference = (beside) => beside?.count > 0 && beside.changed * 2 < beside.count;
function witnessed(beside) {
  if (!beside) return "";
  if (!beside.count) return "No other sensor with this reference can witness: nothing here tells sensor from reference.";
  const others = `${beside.count - beside.changed} of ${beside.count} other sensors with the same reference are steady`;
  return clearsReference(beside) ? `${others}: rather this sensor than its reference.` : `Only ${others}: look at the reference first.`;
}

// The present of a sensor: the time that its gateway has reached while it catches up, as a simulated one may.
const catchesUp = (state) => state === "catching up";
export const timeOf = (row) => (catchesUp(row.gateway_state) && row.gateway_utc_ns) || now();
// The state of a gateway in words.
export const stateOf = (gateway) => (catchesUp(gateway.state) ? `catching up, now at ${day(gateway.told_utc_ns).textContent}` : gateway.state || "on the bus");

// A reference without the digest of its settings.
export const shortName = (reference) => reference.replace(/ [0-9a-f]{12}$/, "");
// The age of the certificate of its reference; where it states no date, since when it is in use.
export function certificate(row, inUse_utc_ns) {
  if (row.calibrated_utc_ns) return [ago(row.calibrated_utc_ns, timeOf(row)), " old"];
  return inUse_utc_ns ? ["without a date, in use since ", day(inUse_utc_ns)] : [];
}

// What the agent (agent.core.explaining) says of windows that stay held, in its parts; null where it says something else.
const EXPLAINED = /^(?<held>\d+) held windows (?<how>contradict the state: |agree with what the state may have become since its last window \()chi-squared (?<none>\d+), (?<limit>\d+) at most(?: if it is right|\))\. (?:(?<fits>Best fits|Nearest, though not within what chance allows, is) another (?<best>.+?): chi-squared (?<least>\d+)(?:, \S+ times smaller)?\.(?: As well fits: (?<alike>.+?)\.(?= [A-Z]))? |No known explanation fits them(?: better)?\. )(?<todo>[^]+)$/;
export function explanation(reason) {
  const found = EXPLAINED.exec(reason)?.groups;
  if (!found) return null;
  const alike = found.alike?.split("; ").map((each) => each.replace(/^another /, "")) ?? [];
  return { held: Number(found.held), none: Number(found.none), limit: Number(found.limit), agree: found.how.startsWith("agree"), fits: found.fits === "Best fits", best: found.best ?? "", least: Number(found.least), alike, todo: found.todo };
}

// "reference drift (reference_drift_z +9.96 %)" as "reference drift along z (+9.96 %)"; what has another form as it is.
export function cause(told) {
  const found = /^(?<what>.+) \((?<name>\S+) (?<size>[-+]\S+)(?<unit> .+)?\)$/.exec(told)?.groups;
  if (!found) return [told];
  const sign = Number(found.size) > 0 ? "+" : "", size = ` (${sign}${short(Number(found.size))}${(found.unit ?? "").replace("m/s2", "m/s²")})`, axis = /_([xyz])$/.exec(found.name)?.[1];
  if (NAMES.includes(found.name)) return [found.what, " ", symbol(found.name), size];
  return [found.what, axis ? ` along ${axis}` : "", size];
}

const COUNTS = ["", "", "Two", "Three", "Four", "Five", "Six"];
function inWords({ best, alike, fits, least, limit }) {
  if (!best) return ["No known explanation fits them better."];
  const all = [best, ...alike], named = all.flatMap((each, k) => [k ? "; " : "", "another ", ...cause(each)]), chi2 = `(chi-squared ${least}, limit ${limit})`;
  if (all.length === 1) return [fits ? "Explained best by " : "Nearest is ", ...named, fits ? ` ${chi2}.` : `, which does not fit within chance ${chi2}.`];
  return [`${COUNTS[all.length] ?? all.length} explanations fit about equally: `, ...named, fits ? ` ${chi2}.` : `; none fits within chance ${chi2}.`];
}

// A gateway cannot tell another reference from another sensor; whether others with this reference contradict it.
const blamesReference = (why) => Boolean(why?.best) && [why.best, ...why.alike].every((each) => each.startsWith("reference "));
const isContradicted = (why, trends) => blamesReference(why) && clearsReference(trends?.beside);

const ON_HOLD = /^put on hold by/;

// {say, more} of a sensor that is held, perhaps with a step.
function heldWords(row, verdicts, trends) {
  const since = ["Held since ", make("b", moment(trends?.held_utc_ns ?? row.status_utc_ns)), verdicts.length ? ". Seen from its reference: " : ": "], why = explanation(row.reason);
  const reason = why ? [`${why.held} windows ${why.agree ? "agree with what the calibration may have become." : "contradict the calibration."}`] : [row.reason, "."];
  return { say: [...since, ...(verdicts.length ? inTurn(verdicts) : reason)], more: [...(why ? [...inWords(why), " "] : verdicts.length ? [...reason, " "] : []), ON_HOLD.test(row.reason) ? "" : `${isContradicted(why, trends) ? "But " : ""}${witnessed(trends?.beside)}`] };
}

// What is said of a sensor that is in order: its largest change of a main sensitivity, and what was adopted.
function soundWords(row, trends) {
  const most = largest(trends), adopted = trends?.adopted_utc_ns ? [" A jump was adopted on ", day(trends.adopted_utc_ns), "; U has been larger since."] : [];
  const change = most ? [` Its largest change since ${trends.accepted ? "the accepted" : "the first"} calibration is that of `, symbol(most.name), `: ${signed(most.pct, most.U)} % (± ${rounded(most.U, most.U)} %)`, most.over > 1 ? `, ${unjudged(trends)[1]}.` : "."] : [];
  return { say: ["No drift and no step is found.", ...adopted], more: [...change, trends?.beside?.count ? ` ${trends.beside.count} other sensors have the same reference.` : ""] };
}

// Why a sensor is in order with a change above its U: [short, in words].
export const unjudged = (trends) => (trends?.adopted_utc_ns ? ["adopted", "which was adopted"] : ["no verdict", "no more than the agent's test lets a sound sensor walk in this time"]);

// The main sensitivity that has changed most over U of its change: {name, pct, U (both in %), over}.
export function largest(trends) {
  const all = MAIN.map((i, k) => ({ ...trends?.changes?.[i], name: NAMES[i], pct: trends?.main_pct?.[k].at(-1) })).filter((c) => finite(c.change) && c.U > 0);
  const most = all.map((c) => ({ name: c.name, pct: c.pct, over: Math.abs(c.change) / c.U, U: Math.abs((c.pct * c.U) / c.change) })).sort((a, b) => b.over - a.over)[0];
  return most && { ...most, U: most.U > 0 && finite(most.U) ? most.U : 0.01 };
}

// Since when nothing is heard of a sensor. What came late is older than that.
function silence(row) {
  const late = row.heard_utc_ns - row.result_utc_ns > DAY_NS ? [" Its results came late: the newest one is of ", make("b", day(row.result_utc_ns)), `, ${ago(row.result_utc_ns)} ago.`] : [];
  return ["Not heard since ", make("b", moment(row.heard_utc_ns)), `, ${ago(row.heard_utc_ns)} ago${row.gateway_state === "silent" ? "" : ", though its gateway is on the bus"}.`, ...late];
}

// {say, more} of a sensor.
export function told(row, trends) {
  const verdicts = findings(row, trends);
  const reason = row.reason ? [row.reason, "."] : [], since = trends?.held_utc_ns ?? row.status_utc_ns;
  if (isUnheard(row)) return { say: silence(row), more: inTurn(verdicts.map((v) => ["Before: ", ...v])) };
  if (row.kind === "doubled") return { say: ["Two gateways have this name, and their results are mixed."], more: inTurn(verdicts.map((v) => ["One of them: ", ...v])) };
  if (row.kind === "held") return heldWords(row, verdicts, trends);
  if (row.kind === "suspected") return suspectedWords(row);
  if (verdicts.length) return { say: inTurn(verdicts), more: [often(row, trends), ...steady(row), witnessed(trends?.beside), ...(row.status === "HELD" ? [" Held: ", ...reason] : [])] };
  if (row.kind === "no data") return { say: ["No data since ", make("b", moment(since)), ": ", ...reason], more: [] };
  if (row.kind === "uncalibrated") return { say: [row.status === "COLLECTING" ? "Windows are being collected: " : "No calibration is in force: ", ...reason], more: [] };
  return soundWords(row, trends);
}

const BELOW = " by the command below";
// What the agent says there is to do, without the command, which stands below; the mount where it knows nothing better.
// Since it said that no estimate can be put in force one may have come (`waits`).
function advice(reason, waits, trends) {
  const why = explanation(reason);
  if (isContradicted(why, trends)) return "Look at the sensor and its mount: its gateway names the reference, but other sensors with this reference are steady.";
  const todo = waits ? why?.todo.replace(/ Otherwise: no estimate can be put in force.*$/, "") : why?.todo;
  const told = why?.best && todo.replace(/: fieldcal command accept --sequence \d+$/, BELOW).replace(/([^.])$/, "$1.");
  if (told?.startsWith("Correct it")) return `Another ${make("span", cause(why.best)).textContent}? ${told}`;
  return told || "Look at the mount. If it is loose, fasten it: windows that fit again end HELD.";
}

const KEYED = "on a machine with your key (KEY: its file; ENDPOINT: the router):";

export const ofDoubled = () => [make("p", "Find the copy (the log of each names its run) and give it another name, data directory and key. Until then, on the copy alone:"), copier("sudo systemctl stop fieldcal")];

// What a person can do: elements with a command to copy, and where to run it.
export function steps(row, trends) {
  const gateway = clean(`${row.site}/${row.gateway}`), order = (verb, given) => commandLine({ gateway, sensor: row.sensor, verb, arguments: given }, "--connect ENDPOINT"), here = `on gateway ${gateway}:`;
  const visit = () => [make("p", `Compare it with another reference, ${here}`), copier(`fieldcal visit gateway.toml --data-dir visit --sensor ${row.sensor}`)];
  const waits = row.estimate && row.estimate_utc_ns >= (trends?.held_utc_ns ?? row.status_utc_ns) && row.status === "HELD";
  const told = row.kind === "held" ? advice(row.reason, waits, trends) : "", asked = told.includes(BELOW) ? `Run it ${KEYED}` : `If the sensor has really changed, accept estimate ${row.estimate}, ${KEYED}`;
  const accept = waits ? [make("p", asked), copier(order("accept", { sequence: row.estimate }))] : [];
  if (row.kind === "silent") return [make("p", `Look at power and network, then ${here}`), copier(`fieldcal doctor ${GATEWAY}`)];
  if (row.kind === "suspected") return suspectedSteps(row);
  if (row.kind === "changed") return [make("p", "Find out what happened to it: mount, cable, temperature, reference."), ...visit()];
  if (row.kind === "drifting") return [...visit(), ...(accept.length ? accept : [make("p", "If that agrees, accept what it shows.")])];
  if (row.kind === "held" && ON_HOLD.test(row.reason)) return [make("p", `An operator put it on hold. To use windows again, ${KEYED}`), copier(order("hold", { release: true }))];
  if (row.kind === "held") return [make("p", told), ...(accept.length ? accept : [make("p", `What it knows, ${here}`), copier("fieldcal show --data-dir /var/lib/fieldcal")])];
  if (row.kind === "doubled") return ofDoubled();
  if (row.kind === "no data") return [make("p", `Check power and cables of the sensor, then ${here}`), copier(`fieldcal doctor ${GATEWAY}`)];
  if (row.kind === "uncalibrated") return [make("p", `Turn the sensor to the position that the log names, ${here}`), copier("journalctl -fu fieldcal -o cat")];
  return [];
}

// The year of a card until today: of the parameter that it is of, with its U and the begin of its change, or of the three
// main sensitivities. What is in force stays so; what is not, the newest estimates of a sensor that is held, is dashed.
export function cardPlot(row, trends) {
  if (!trends?.t_utc_ns?.length) return [];
  const verdict = row.verdicts[0], trend = verdict && trends.found?.[verdict.parameter], beyond = trends.estimates ?? [], later = beyond.map((e) => e.t_utc_ns);
  const marks = trends.refused_utc_ns ? [trends.held_utc_ns] : [], to = isUnheard(row) ? trends.t_utc_ns.at(-1) : timeOf(row), stays = !isUnheard(row) && row.kind !== "no data";
  const more = { marks, to, refused: trends.refused_utc_ns ?? [], dashed: later.length > 0 };
  if (!trend?.t_utc_ns.length) return [small(trends.main_pct.flatMap((v, i) => [going(trends.t_utc_ns, v, null, AXES[i], stays && to), ...estimated(later, beyond.map((e) => e.main_pct[i]), null, AXES[i])]), " %", "Main S", more)];
  const { unit, factor } = scaled(verdict.parameter, trend.scale), first = trend.values[0], k = NAMES.indexOf(verdict.parameter), tone = toneOf(verdict.parameter);
  const part = (v) => (finite(v) ? (v - first) * factor : null), u = (v) => 2 * v * factor, onset = trend.change?.onset_utc_ns ?? verdict.onset_utc_ns;
  const curves = [going(trend.t_utc_ns, trend.values.map(part), trend.u.map(u), tone, stays && to), ...estimated(later, beyond.map((e) => part(e.values[k])), beyond.map((e) => u(e.u[k])), tone)];
  return [small(curves, unit, verdict.parameter, { ...more, marks: marks.length ? marks : [onset] })];
}

// A curve that goes on as it ends until `to`, where it does.
const going = (t, v, u, tone, to) => (to ? { t: [...t, to], v: [...v, v.at(-1)], u: u && [...u, u.at(-1)], tone } : { t, v, u, tone });
const estimated = (t, v, u, tone) => (t.length ? [{ t, v, u, tone, dashed: true }] : []);

function small(curves, unit, name, { marks, to, refused, dashed }) {
  const all = curves.flatMap(({ v, u }) => v.flatMap((each, k) => [each - (u?.[k] ?? 0), each + (u?.[k] ?? 0)])).filter(finite), from = curves[0].t[0];
  const least = unit === " %" ? LEAST_PCT : 0, low = Math.min(-least, ...all), high = Math.max(least, ...all), label = `${name}: ${signed(low, 0.1 * (high - low))} to ${signed(high, 0.1 * (high - low))}${unit}`;
  const words = `${label}${dashed ? "; dashed: estimates" : ""}`;
  return make("figure", [spark(`${words}${refused.length ? "; triangles: windows that were not used" : ""}, from ${utcDay(from)} to ${utcDay(to)}`, curves, [from, to, low, high], marks, 46, refused),
    make("figcaption", [make("span", words, { class: "of" }), day(from), day(to)])]);
}
const utcDay = (ns) => day(ns).textContent;
