// What is said of a sensor: its verdicts in sentences, what else is steady, and what a person can do.
import { commandLine } from "./commands.js";
import { make } from "./common.js";
import { ago, AXES, day, DAY_NS, duration, finite, MAIN, moment, NAMES, now, rounded, signed, symbol, two } from "./format.js";
import { copier, spark } from "./parts.js";

const LEAST_PCT = 0.2; // half the range of a small plot at least, so that noise is not made large
const MONTH_DAYS = 30.44, YEAR_DAYS = 365.25;
const GATEWAY = "/etc/fieldcal/gateway.toml --data-dir /var/lib/fieldcal";
export const toneOf = (parameter) => AXES.at(Math.max(0, AXES.indexOf(parameter[1])));

// A size in % of the main sensitivity of its output; of an offset in m/s².
function scaled(parameter, scale) {
  const known = finite(scale) && scale !== 0, offset = parameter[0] === "Q";
  return { unit: !known ? "" : offset ? " m/s²" : " %", factor: !known ? 1 : (offset ? 1 : 100) / Math.abs(scale) };
}

const pair = (v, U, unit) => [make("b", `${rounded(Math.abs(v), U)}${unit}`), finite(U) ? ` (± ${two(U)}${unit})` : ""];
const spread = (days) => (finite(days) ? ` (± ${duration(2 * days * DAY_NS)})` : "");

// One verdict in a sentence, by the history where it shows the change, else by the verdict itself, with its date.
export function sentence(verdict, trend) {
  const change = trend?.change, { unit, factor } = scaled(verdict.parameter, trend?.scale), name = symbol(verdict.parameter);
  const of = change ?? { size: verdict.change, u_size: verdict.u_change, rate: verdict.rate, u_rate: verdict.u_rate, onset_utc_ns: verdict.onset_utc_ns };
  const size = pair(of.size * factor, 2 * of.u_size * factor, unit), since = [day(of.onset_utc_ns), spread(of.u_onset_days)];
  const told = change ? "." : ["; told on ", day(verdict.t_utc_ns), "."];
  if ((change?.shape ?? verdict.verdict) === "stepped") return [name, of.size < 0 ? " fell by " : " rose by ", ...size, " at once, on ", ...since, told].flat();
  const days = Math.abs(of.rate * factor * MONTH_DAYS) < 0.1 ? [YEAR_DAYS, "year"] : [MONTH_DAYS, "month"];
  const rate = pair(of.rate * factor * days[0], 2 * of.u_rate * factor * days[0], unit);
  return [name, of.rate < 0 ? " falls by " : " rises by ", ...rate, ` a ${days[1]}, `, ...size, " since ", ...since, told].flat();
}

function often(verdict) {
  const years = 1 / verdict.false_alarms_a_year;
  return finite(years) && years > 0 ? `A sound sensor is told so once in ${two(years)} years at most.` : "";
}

function steady(row) {
  const moved = new Set(row.verdicts.map((v) => v.parameter)), main = MAIN.map((i) => NAMES[i]).filter((name) => !moved.has(name));
  const offset = ["Qx", "Qy", "Qz"].some((name) => moved.has(name)) ? [] : ["Q"];
  const names = [...main.map(symbol), ...offset];
  return names.length ? ["Steady: ", ...names.flatMap((name, i) => (i ? [", ", name] : [name])), ". "] : [];
}

// What explains it best, by the other sensors with the same reference.
function cause(beside) {
  if (!beside?.count) return "No other sensor has this reference: nothing here tells sensor from reference.";
  const others = `${beside.count - beside.changed} of ${beside.count} other sensors with the same reference are steady`;
  return beside.changed * 2 >= beside.count ? `Only ${others}: look at the reference first.` : `${others}: rather this sensor than its reference.`;
}

// The time of a sensor's gateway: that of its newest result while it catches up, as a simulated one may.
const catchesUp = (state) => state === "catching up";
export const timeOf = (row) => (catchesUp(row.gateway_state) ? row.result_utc_ns : now());
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

const inWords = ({ best, alike, fits, least, none }) => (!best ? "No known explanation fits them better." : `${fits ? "Explained best by" : "Nearest, but not within what chance allows:"} another ${[best, ...alike].join(", or another ")}: chi-squared ${least} in place of ${none}.`);

// {say, more} of a sensor that is held, perhaps with a step.
function heldWords(row, verdicts, trends) {
  const since = ["Held since ", make("b", moment(trends?.held_utc_ns ?? row.status_utc_ns)), ": "], why = explanation(row.reason), kept = trends?.accepted_utc_ns ? [" The calibration before stays in force."] : [];
  const reason = why ? [`${why.held} windows ${why.agree ? "agree with what the calibration may have become." : "contradict the calibration."}`] : [row.reason, "."];
  return { say: [...since, ...(verdicts.length ? verdicts.flatMap((v) => [...v, " "]) : reason)], more: [...(why ? [inWords(why)] : verdicts.length ? reason : []), ...kept] };
}

// {say, more} of a sensor that is not in order.
export function told(row, trends) {
  const verdicts = row.verdicts.map((v) => sentence(v, trends?.found?.[v.parameter]));
  const reason = row.reason ? [row.reason, "."] : [], since = trends?.held_utc_ns ?? row.status_utc_ns;
  if (row.kind === "silent") return { say: ["Not heard since ", make("b", moment(row.heard_utc_ns)), ` (${duration(now() - row.heard_utc_ns)}). Its calibration was ${row.status || "not known"} then; nobody knows now.`], more: verdicts.flatMap((v) => ["Before: ", ...v, " "]) };
  if (row.kind === "held") return heldWords(row, verdicts, trends);
  if (verdicts.length) return { say: verdicts.flatMap((v) => [...v, " "]), more: [often(row.verdicts[0]), " ", ...steady(row), cause(trends?.beside), ...(row.status === "HELD" ? [" Held: ", ...reason] : [])] };
  if (row.kind === "no data") return { say: ["No data since ", make("b", moment(since)), ": ", ...reason], more: ["What is in force was right then."] };
  if (row.kind === "uncalibrated") return { say: [row.status === "COLLECTING" ? "Windows are being collected: " : "No calibration is in force: ", ...reason], more: [] };
  return { say: ["No drift and no step is found", row.last_good_utc_ns ? [". The last good window is of ", moment(row.last_good_utc_ns)] : "", "."].flat(), more: trends?.beside?.count ? [`${trends.beside.count} other sensors have the same reference.`] : [] };
}

const BELOW = " by the command below";
// What the agent says there is to do, without the command, which stands below; the mount where it knows nothing better.
function advice(reason) {
  const why = explanation(reason), told = why?.best && why.todo.replace(/: fieldcal command accept --sequence \d+$/, BELOW).replace(/([^.])$/, "$1.");
  if (told?.startsWith("Correct it")) return `Another ${why.best}? ${told}`;
  return told || "Look at the mount. If it is loose, fasten it: windows that fit again end HELD.";
}

// What a person can do: elements with a command to copy.
export function steps(row, trends) {
  const gateway = `${row.site}/${row.gateway}`, order = (verb, given) => commandLine({ gateway, sensor: row.sensor, verb, arguments: given }, "--connect ENDPOINT");
  const waits = row.estimate && row.estimate_utc_ns >= (trends?.held_utc_ns ?? row.status_utc_ns) && row.status === "HELD";
  const told = row.kind === "held" ? advice(row.reason) : "", asked = told.includes(BELOW) ? [] : [make("p", `If the sensor has really changed, accept estimate ${row.estimate}:`)];
  const accept = waits ? [...asked, copier(order("accept", { sequence: row.estimate }))] : [];
  if (row.kind === "silent") return [make("p", "Look at power and network, then on the gateway:"), copier(`fieldcal doctor ${GATEWAY}`)];
  if (row.kind === "drifting") return [make("p", "Compare it with another reference. If that agrees, accept what it shows."), copier(`fieldcal visit gateway.toml --data-dir visit --sensor ${row.sensor}`), ...accept];
  if (row.kind === "held" && /^put on hold by/.test(row.reason)) return [make("p", "An operator put it on hold. To use windows again:"), copier(order("hold", { release: true }))];
  if (row.kind === "held") return [make("p", told), ...(accept.length ? accept : [copier("fieldcal show --data-dir /var/lib/fieldcal")])];
  if (row.kind === "no data") return [make("p", "Check power and cables of the sensor, then on the gateway:"), copier(`fieldcal doctor ${GATEWAY}`)];
  if (row.kind === "uncalibrated") return [make("p", "Turn the sensor to the position that the log names:"), copier("journalctl -fu fieldcal -o cat")];
  return [];
}

// A year of the parameter that a card is of, with its U and the begin of its change.
export function cardPlot(row, trends) {
  const verdict = row.verdicts[0], trend = verdict && trends?.found?.[verdict.parameter];
  if (!trend?.t_utc_ns.length) return trends?.t_utc_ns?.length ? [small(trends.t_utc_ns, trends.main_pct.map((v, i) => ({ v, tone: AXES[i] })), " %", "Sxx, Syy, Szz", [])] : [];
  const { unit, factor } = scaled(verdict.parameter, trend.scale), first = trend.values[0];
  const v = trend.values.map((each) => (each - first) * factor), u = trend.u.map((each) => 2 * each * factor);
  return [small(trend.t_utc_ns, [{ v, u, tone: toneOf(verdict.parameter) }], unit, verdict.parameter, [trend.change?.onset_utc_ns ?? verdict.onset_utc_ns])];
}

function small(t, curves, unit, name, marks) {
  const all = curves.flatMap(({ v, u }) => v.flatMap((each, k) => [each - (u?.[k] ?? 0), each + (u?.[k] ?? 0)])).filter(finite);
  const least = unit === " %" ? LEAST_PCT : 0, low = Math.min(-least, ...all), high = Math.max(least, ...all), label = `${name}: ${signed(low, 0.1 * (high - low))} to ${signed(high, 0.1 * (high - low))}${unit}`;
  return make("figure", [spark(`${label}, from ${utcDay(t[0])} to ${utcDay(t.at(-1))}`, curves.map((curve) => ({ t, ...curve })), [t[0], t.at(-1), low, high], marks, 46),
    make("figcaption", [make("span", label, { class: "of" }), day(t[0]), day(t.at(-1))])]);
}
const utcDay = (ns) => day(ns).textContent;
