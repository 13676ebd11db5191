// The view of one sensor: S and Q with U over time, response, drift, windows, devices, history, and its commands.
import { $, at, clean, get, make, placeOf, table, text, view } from "./common.js";
import { opener, poseForm } from "./commands.js";
import { drawRows } from "./diagram.js";
import { savePlots } from "./picture.js";
import { boxOf, curves, TimePlots } from "./plots.js";

const AXES = ["x", "y", "z"];
const NAMES = [...AXES.flatMap((i) => AXES.map((j) => `S${i}${j}`)), ...AXES.map((i) => `Q${i}`)];
const NEWEST = 100; // results of each kind that are asked for, beside the calibrations of the whole history
const KINDS = ["calibration", "window", "drift", "status", "estimate", "clock"];
const value = (c, i) => (i < 9 ? c.sensitivity[Math.floor(i / 3)][i % 3] : c.offset[i - 9]);
const finite = (v) => typeof v === "number" && Number.isFinite(v);
const short = (v) => (finite(v) ? Number(v.toPrecision(5)).toString() : "not known");
let current = null; // {place, changed, plots}

function onsetsOf(drifts) {
  const newest = Object.fromEntries(drifts.map((d) => [d.parameter, d]));
  return NAMES.map((name) => (newest[name] && newest[name].verdict !== "stable" ? [newest[name].onset_utc_ns / 1e9] : []));
}

function seriesOf(calibrations, drifts) {
  const unit = clean(calibrations.at(-1)?.output_unit), onsets = onsetsOf(drifts);
  return NAMES.map((name, i) => ({
    label: name, title: `${name}, ${unit}${i < 9 ? " per m/s²" : ""}`, onsets: onsets[i],
    values: calibrations.map((c) => value(c, i)), u: calibrations.map((c) => c.standard_uncertainty[i]),
  }));
}

const section = (title, ...content) => make("section", [make("h3", title), ...content.flat()]);
const csv = (place, what) => make("p", make("a", "CSV", { href: `sensor.csv?${place}&what=${what}` }));
const newestFirst = (rows) => rows.slice().reverse();

function responseSection(newest, later) {
  const bands = newest?.response ?? [];
  if (!bands.length) return [];
  const box = boxOf("Response over frequency: main sensitivities against the sensitivity in force, in %");
  const middle = bands.map((b) => Math.sqrt(Math.max(b.low_hz, 0.1 * b.high_hz) * b.high_hz));
  const part = (b, i) => [b.sensitivity_re[i][i], b.standard_uncertainty[i][i]].map((v) => (100 * v) / newest.sensitivity[i][i]);
  const series = AXES.map((axis, i) => ({ label: `S${axis}${axis}`, values: bands.map((b) => part(b, i)[0] - 100), u: bands.map((b) => part(b, i)[1]) }));
  later.push(() => curves(box, "Re S(f) against S in force, %", middle, series, true));
  const rows = bands.map((b) => [`${short(b.low_hz)} to ${short(b.high_hz)}`, ...AXES.map((_, i) => `${short(b.sensitivity_re[i][i])} ± ${short(2 * b.standard_uncertainty[i][i])}, imaginary ${short(b.sensitivity_im[i][i])}`)]);
  return section(`Response over frequency; S holds at ${short(newest.reference_frequency_hz)} Hz`, box, table("Response over frequency", ["Hz", "Sxx", "Syy", "Szz"], rows));
}

function temperatureSection(last, whole, later) {
  const known = whole.filter((c) => finite(c.reference_temperature_degc));
  if (!known.length) return section("Temperature", make("p", "The device measures no temperature."));
  const box = boxOf("Temperature over time: of reference, and the range of the data");
  const keys = [["of reference", "reference_temperature_degc"], ["lowest", "temperature_low_degc"], ["highest", "temperature_high_degc"]];
  later.push(() => curves(box, "Temperature, °C", known.map((c) => c.t_utc_ns / 1e9), keys.map(([label, key]) => ({ label, values: known.map((c) => c[key]) })), false, true));
  const told = `Q holds at ${short(last.reference_temperature_degc)} °C; data from ${short(last.temperature_low_degc)} to ${short(last.temperature_high_degc)} °C.`;
  const slopes = (last.offset_temperature ?? []).map((row, k) => `Q by temperature, order ${k + 1}: ${row.map(short).join(", ")} ${last.output_unit}/K${k ? `^${k + 1}` : ""}. `);
  return section("Temperature", make("p", [told, " ", ...slopes]), box);
}

function devicesSection(newest, clocks) {
  const devices = Object.values(Object.fromEntries(clocks.map((c) => [c.device, c])));
  const rows = devices.map((c) => [c.device, c.role, `${short(c.rate_hz)} of ${short(c.nominal_rate_hz)}`, finite(c.lag_s) ? `${short(1000 * c.lag_s)} ± ${short(2000 * c.u_lag_s)}` : "", short(1000 * c.jitter_s)]);
  const shared = (newest?.shared_errors ?? []).map((s) => [s.reference, s.serial_number, s.sensitivity.map(short).join(", "), s.certificate_sha256.slice(0, 16)]);
  return section("Devices and certificates",
    make("p", newest ? [`Sensor: ${newest.identity}. References: ${newest.references.join("; ") || "none"}. `, newest.signed_by ? `Signed with the key ${newest.signed_by}.` : "Not verified."] : "No calibration yet."),
    ...(rows.length ? [table("Clocks of the devices", ["Device", "Role", "Rate, Hz", "Lag, ms (U)", "Jitter, ms"], rows)] : []),
    ...(shared.length ? [table("References", ["Reference", "Serial number", "Sensitivity by certificate", "SHA-256 of the certificate"], shared)] : []));
}

function spaceSection(newest, later) {
  if (!newest) return [];
  const canvas = make("canvas", [], { role: "img", "aria-label": "Rows of S in space; a row on its axis has no transverse sensitivity", class: "space" });
  later.push(() => drawRows(canvas, newest.sensitivity));
  return section("Rows of S in space", canvas);
}

function inForceSection(place, newest) {
  if (!newest) return [];
  const rows = NAMES.map((name, i) => [name, short(value(newest, i)), finite(newest.standard_uncertainty[i]) ? short(2 * newest.standard_uncertainty[i]) : "not known", `${newest.output_unit}${i < 9 ? " per m/s²" : ""}`, newest.determined[i] ? "yes" : "no"]);
  return section("In force", table("In force", ["Parameter", "Value", "U (k = 2)", "Unit", "Determined by data"], rows), csv(place, "calibration"));
}

// The advice looks at the peers too, so it comes later than the rest.
function adviceSection(place) {
  const box = make("div", "is being computed");
  get(`api/advice?${place}`).then((advice) => box.replaceChildren(adviceTable(advice)), () => box.replaceChildren(text("not known")));
  return section("When to look again", make("p", "Interval in which a change stays within the limit with 95 %, from the history (control chart, ILAC-G24)."), box, make("p", make("a", "CSV", { href: `advice.csv?${place}` })));
}

function adviceTable(advice) {
  const rows = advice.map((a) => [a.subject, a.interval_days === null ? "not yet" : `${short(a.interval_days)} days`, a.due_utc_ns ? at(a.due_utc_ns) : "", a.reason]);
  return table("When to look again", ["Of", "Interval", "Due (UTC)", "Reasoning"], rows);
}

// Results before those that are kept in full: counts of each hour.
function hoursSection(place, hours) {
  const rows = newestFirst(hours).map((r) => [at(r.t_utc_ns), r.status, r.calibrations, r.estimates, r.windows_used, r.windows_refused, r.clocks]);
  return section("Summarised hours", table("Summarised hours", ["Until (UTC)", "Status", "Calibrations", "Estimates", "Windows used", "Windows refused", "Clock reports"], rows), make("p", make("a", "CSV", { href: `hours.csv?${place}` })));
}

function sections(place, told, whole, hours, later) {
  const gateway = `${place.get("site")}/${place.get("gateway")}`, sensor = place.get("sensor");
  const { calibration, window, drift, status, estimate, clock } = told, newest = calibration.at(-1);
  const order = (verb, sequence) => ({ gateway, sensor, verb, arguments: { sequence } });
  const numbers = (w) => Object.entries(w.numbers).map(([name, v]) => `${name} ${short(v)}`).join(", ");
  return [
    inForceSection(place, newest),
    section("Drift", table("Drift", ["UTC", "Parameter", "Verdict", "Since", "Reason"], newestFirst(drift).map((r) => [at(r.t_utc_ns), r.parameter, r.verdict, r.verdict === "stable" ? "" : at(r.onset_utc_ns), r.reason])), csv(place, "drift")),
    adviceSection(place),
    section("Estimates that are not in force", table("Estimates", ["UTC", "Number", "Why not in force", "Accept"], newestFirst(estimate).map((r) => [at(r.t_utc_ns), r.sequence, r.reason, opener(`Accept ${r.sequence}`, order("accept", r.sequence))])), csv(place, "estimate")),
    section("History of calibrations", table("Calibrations", ["UTC", "Number", "Windows", "Method", "Roll back"], newestFirst(calibration).map((r, i) => [at(r.t_utc_ns), r.sequence, r.windows, r.method, i === 0 ? "in force" : opener(`Roll back to ${r.sequence}`, order("rollback", r.sequence))]))),
    responseSection(newest, later),
    spaceSection(newest, later),
    temperatureSection(newest, whole, later),
    section("Status", table("Status", ["UTC", "Status", "Reason"], newestFirst(status).map((r) => [at(r.t_utc_ns), r.status, r.reason])), csv(place, "status")),
    section("Windows", table("Windows", ["UTC", "Position", "Verdict", "Reason", "Numbers"], newestFirst(window).map((r) => [at(r.t_utc_ns), r.position, r.used ? "used" : "refused", r.reason, numbers(r)])), csv(place, "window")),
    hoursSection(place, hours),
    devicesSection(newest, clock),
  ].flat();
}

function liveSection(place) {
  const box = make("div"), told = make("p", [], { role: "status" });
  let source = null;
  const button = make("button", "Show the live waveform", { type: "button" });
  const stop = () => { source?.close(); source = null; button.textContent = "Show the live waveform"; };
  button.addEventListener("click", () => {
    if (source) return stop();
    button.textContent = "Stop";
    told.replaceChildren(text("waiting for a block; the gateway sends none unless its channel publishes acceleration"));
    source = new EventSource(`api/live?${place}`);
    source.onmessage = (message) => {
      const block = JSON.parse(message.data), plot = box.firstChild ?? box.appendChild(boxOf("Corrected acceleration, newest block"));
      told.replaceChildren(text(`corrected acceleration by calibration ${block.calibration_sequence || "of the prior"}, ${short(block.rate_hz)} Hz`));
      curves(plot, "a, m/s²", block.acceleration.map((_, k) => k / block.rate_hz), AXES.map((label, i) => ({ label, values: block.acceleration.map((row) => row[i]) })), false);
    };
    return undefined;
  });
  return [section("Live", make("p", button), told, box), stop];
}

function begin(place) {
  const gateway = `${place.get("site")}/${place.get("gateway")}`, sensor = place.get("sensor");
  const hold = (given) => ({ gateway, sensor, verb: "hold", arguments: given }), [live, stop] = liveSection(place);
  $("name").replaceChildren(text(`${gateway}/${sensor}`));
  $("commands").replaceChildren(live, section("Commands", make("p", [opener("Hold", hold({})), " ", opener("Release", hold({ release: true }))]), poseForm(gateway, sensor)));
  $("plots").replaceChildren();
  $("details").replaceChildren();
  return stop;
}

// Shows the sensor of the address; asks for its results only when its row has changed. `go` changes the address.
export async function showSensor(told, go) {
  const now = view(), place = new URLSearchParams(["site", "gateway", "sensor"].map((n) => [n, now.get(n) ?? ""]));
  const row = told.sensors.find((r) => placeOf(r).toString() === place.toString());
  $("state").replaceChildren(text(row ? row.why || row.status : "the monitor has no results of this sensor"));
  if (current?.place !== place.toString()) {
    leaveSensor();
    current = { place: place.toString(), changed: null, stop: begin(place), plots: new TimePlots($("plots"), (range) => go({ from: range?.[0].toFixed(0), to: range?.[1].toFixed(0), days: "" })) };
  }
  const mine = current;
  if (mine.changed !== (row?.changed ?? 0)) {
    mine.changed = row?.changed ?? 0;
    const [whole, hours, ...results] = await Promise.all([get(`api/spread?${place}`), get(`api/hours?${place}&limit=${NEWEST}`), ...KINDS.map((what) => get(`api/history?${place}&what=${what}&limit=${NEWEST}`))]);
    if (current !== mine) return;
    const found = Object.fromEntries(KINDS.map((what, i) => [what, results[i]])), later = [];
    mine.last = (whole.at(-1)?.t_utc_ns ?? 0) / 1e9;
    mine.plots.update(whole.map((c) => c.t_utc_ns / 1e9), seriesOf(whole, found.drift));
    $("details").replaceChildren(...sections(place, found, whole, hours, later));
    for (const draw of later) draw();
  }
  const days = Number(now.get("days")), from = Number(now.get("from")), to = Number(now.get("to")), zoom = from > 0 && to > from;
  $("span").value = zoom ? "zoom" : now.get("days") ?? "";
  const range = zoom ? [from, to] : days > 0 ? [mine.last - 86400 * days, mine.last] : null;
  if (`${range}` !== `${mine.plots.range}`) mine.plots.setRange(range);
}

export function leaveSensor() {
  current?.stop();
  current = null;
}

export function startSensor(go) {
  $("span").addEventListener("input", () => $("span").value !== "zoom" && go({ days: $("span").value, from: "", to: "" }));
  $("sensor-png").addEventListener("click", () => savePlots([...$("sensor").querySelectorAll(".plot")], $("name").textContent, "sensor.png"));
}
