// Numbers with their uncertainty, and times in the reader's zone.
import { clean, make } from "./common.js";

export const AXES = ["x", "y", "z"];
export const NAMES = [...AXES.flatMap((i) => AXES.map((j) => `S${i}${j}`)), ...AXES.map((i) => `Q${i}`)];
export const MAIN = [0, 4, 8]; // of NAMES
export const DAY_NS = 86400e9;
export const finite = (v) => typeof v === "number" && Number.isFinite(v);
const minus = (string) => string.replace(/^-(?=0(\.0*)?$)/, "").replace("-", "\u2212");

// Digits behind the point that show two digits of U; below 0: tens, hundreds, ...
const decimals = (U) => Math.min(12, 1 - Number(U.toExponential(1).split("e")[1]));
const whole = (v, n) => (n < 0 ? Math.round(v / 10 ** -n) * 10 ** -n : v);
const fixed = (v, n) => (Math.abs(v) < 1e15 ? whole(v, n).toFixed(Math.max(0, n)) : v.toExponential(2));
export const rounded = (v, U) => (finite(v) ? minus(finite(U) && U > 0 ? fixed(v, decimals(U)) : Number(v.toPrecision(4)).toString()) : "not known");
export const signed = (v, U) => (finite(v) && Number(fixed(v, finite(U) && U > 0 ? decimals(U) : 12)) > 0 ? `+${rounded(v, U)}` : rounded(v, U));
// Two digits that count; all digits before the point.
export function two(v) {
  if (!finite(v)) return "not known";
  return minus(v === 0 ? "0" : fixed(v, Math.max(0, decimals(Math.abs(v)))));
}
// `value ± U`, both to the second digit of U.
export const plusMinus = (v, U) => (!finite(v) ? "not known" : finite(U) && U > 0 ? `${rounded(v, U)} ± ${rounded(U, U)}` : rounded(v));
export const short = (v) => (finite(v) ? minus(Number(v.toPrecision(5)).toString()) : "not known");
export const band = (hz) => (hz?.length === 2 ? `${two(hz[0])} – ${two(hz[1])} Hz` : "");

export function duration(ns) {
  const s = Math.max(0, ns / 1e9);
  if (s < 120) return `${Math.round(s)} s`;
  if (s < 7200) return `${Math.round(s / 60)} min`;
  if (s < 172800) return `${Math.round(s / 3600)} h`;
  return s < 730 * 86400 ? `${Math.round(s / 86400)} d` : `${(s / 31557600).toFixed(1)} years`;
}

let behind = 0; // ns by which this machine's clock is behind the monitor's
export const setNow = (ns) => { behind = ns - Date.now() * 1e6; };
export const now = () => Date.now() * 1e6 + behind;
export const ago = (ns, at = now()) => (ns ? duration(at - ns) : "never");

// A stranger may send times that no date can hold.
const held = (ns) => finite(ns) && Math.abs(ns) < 8e21;
export const utc = (ns) => (held(ns) ? new Date(ns / 1e6).toISOString().slice(0, 19).replace("T", " ") : "no time");

// The words of the page are English, so the dates are too; the zone is the reader's.
const LOCALE = "en-US", CLOCK = { hour: "2-digit", minute: "2-digit", hourCycle: "h23" };
export const clockTime = () => new Date().toLocaleTimeString(LOCALE, { ...CLOCK, second: "2-digit" });
const thisYear = (date) => date.getFullYear() === new Date().getFullYear();
function words(ns, clock) {
  if (!held(ns)) return "no time";
  const date = new Date(ns / 1e6), year = thisYear(date) ? {} : { year: "numeric" };
  return date.toLocaleString(LOCALE, { day: "numeric", month: "short", ...year, ...(clock ? CLOCK : {}) });
}

// A time in the reader's zone, with UTC on hover.
export const day = (ns) => make("time", words(ns, false), { title: `${utc(ns)} UTC`, datetime: held(ns) ? new Date(ns / 1e6).toISOString() : null });
export const moment = (ns) => make("time", words(ns, true), { title: `${utc(ns)} UTC`, datetime: held(ns) ? new Date(ns / 1e6).toISOString() : null });

// Sxx with its indices below.
export function symbol(name) {
  const known = NAMES.includes(name);
  return make("span", known ? [name[0], make("sub", name.slice(1))] : clean(name), { class: "symbol" });
}
