// The live view of one sensor: the newest block of its corrected stream, its last minute and its spectrum. The monitor
// listens to the sensor as long as the view is open and seen, and for a quarter of an hour at most.
import { $, make, text, view } from "./common.js";
import { AXES, duration } from "./format.js";
import { colours } from "./plots.js";

const UNITS = { density: ["(m/s²)²/Hz", (v) => v], amplitude: ["(m/s²)/√Hz", Math.sqrt] };
const few = (value) => Number(value.toPrecision(3)).toString();

const LATE_MS = 5000; // a gateway sends two blocks a second
let source = null, of = "", minute = null, blockAt = 0;
const plots = new Map();

const say = (words) => $("live-told").replaceChildren(text(words));

function placeOfView() {
  const now = view();
  return new URLSearchParams(["site", "gateway", "sensor"].map((name) => [name, now.get(name) ?? ""]));
}

function begin() {
  stop();
  const place = placeOfView();
  of = place.toString();
  $("live-name").replaceChildren(make("a", `${place.get("site")}/${place.get("gateway")}/${place.get("sensor")}`, { href: `#${place}` }));
  say("Waiting for a block. The gateway sends none unless its channel has acceleration = \"publish\" or \"record\".");
  source = new EventSource(`api/live?minute=1&${place}`);
  blockAt = 0;
  source.onmessage = (message) => { blockAt = performance.now(); drawBlock(JSON.parse(message.data)); };
  source.addEventListener("minute", (message) => { minute = JSON.parse(message.data); drawMinute(); });
  source.addEventListener("end", () => ended("Ended after a quarter of an hour."));
  source.onerror = () => { if (source?.readyState === EventSource.CLOSED) ended("The monitor gives no stream now: too many people look at signals, or you must log in."); };
  $("live-go").textContent = "Stop";
}

function stop() {
  source?.close();
  source = null;
  $("live-go").textContent = "Show the signal";
}

// What is shown is old then, and said to be so.
function listen() {
  const since_ms = performance.now() - blockAt;
  if (source && blockAt && since_ms > LATE_MS) say(`No block for ${duration(since_ms * 1e6)}. What is shown is of then.`);
}

function ended(words) {
  stop();
  say(words);
}

const isDecade = (v) => Math.abs(Math.log10(v) - Math.round(Math.log10(v))) < 1e-9;

// Whole decades; what is ten decades below the greatest value is rounding.
function decades(_, low, high) {
  const top = 10 ** Math.ceil(Math.log10(high || 1));
  return [Math.max(10 ** Math.floor(Math.log10(low || top / 10)), top * 1e-10), top];
}

// One plot for each title; it is made anew where its curves or its scales change.
function plot(id, title, x, curves, more = {}) {
  const { log, bands, unit } = more, box = $(id), ink = getComputedStyle(document.body).color, key = `${title} ${box.clientWidth} ${ink}`, axis = { stroke: ink, grid: { stroke: "#8883" }, ticks: { stroke: "#8883" } }, marks = log ? { filter: (_, splits) => splits.map((v) => (isDecade(v) ? v : null)), grid: { show: false }, ticks: { show: false } } : {};
  if (plots.get(id)?.key === key) { plots.get(id).plot.setData([x, ...curves.map((one) => one.values)]); return; }
  plots.get(id)?.plot.destroy();
  const distr = log ? 3 : 1, series = curves.map((one) => ({ label: one.label, stroke: one.edge ? "transparent" : one.stroke, width: 1, points: { show: false }, value: (_, v) => (v === null || v === undefined ? "–" : few(v)) }));
  const made = new uPlot({
    title, width: box.clientWidth || 320, height: 240, scales: { x: { time: false, distr }, y: log ? { distr, range: decades } : {} }, bands, cursor: { drag: { setScale: false } },
    axes: [{ ...axis, label: unit[0], labelSize: 18, ...marks }, { ...axis, size: 64, label: unit[1], labelSize: 18, ...marks, ...(log ? { values: (_, ticks) => ticks.map((v) => (v ? v.toExponential(0) : "")) } : {}) }],
    series: [{ label: unit[0], value: (_, v) => (v === null || v === undefined ? "–" : few(v)) }, ...series],
  }, [x, ...curves.map((one) => one.values)], box);
  [...box.querySelectorAll(".u-series")].forEach((label, i) => { label.hidden = Boolean(curves[i - 1]?.edge); });
  plots.set(id, { key, plot: made });
}

const meanOf = (values) => values.reduce((sum, v) => sum + v, 0) / values.length;

// Each axis without its mean, so that gravity does not make the motion flat; the words tell the means.
function drawBlock(block) {
  const values = AXES.map((_, i) => block.acceleration.map((row) => row[i])), means = values.map(meanOf), tones = colours();
  say(`Corrected acceleration by calibration ${block.calibration_sequence || "of the prior"}, ${few(block.rate_hz)} Hz. Means of the newest block: ${AXES.map((label, i) => `${label} ${few(means[i])}`).join(", ")} m/s².`);
  plot("live-block", "Newest block, each axis without its mean", block.acceleration.map((_, k) => k / block.rate_hz), AXES.map((label, i) => ({ label, stroke: tones[i], values: values[i].map((v) => v - means[i]) })), { unit: ["s", "m/s²"] });
}

// What is known of the minute: each axis between its least and its greatest value, without its mean, and its spectrum.
function drawMinute() {
  const { course, seconds, frequency_hz: hz, density } = minute, count = course.low[0].length, x = course.low[0].map((_, k) => -seconds + (seconds * (k + 0.5)) / count), curves = [], bands = [], tones = colours();
  AXES.forEach((label, i) => {
    const middle = meanOf([...course.low[i], ...course.high[i]]), at = curves.length + 1;
    curves.push({ label: `${label} greatest`, stroke: tones[i], values: course.high[i].map((v) => v - middle) }, { label: `${label} least`, stroke: tones[i], edge: true, values: course.low[i].map((v) => v - middle) });
    bands.push({ series: [at, at + 1], fill: `${tones[i]}66` });
  });
  plot("live-minute", "Last minute, each axis without its mean", x, curves, { unit: ["s", "m/s²"], bands });
  const lost = minute.begun_anew ? `; begun anew ${minute.begun_anew} times, because samples were lost` : "";
  if (!minute.segments) {
    $("live-spectrum-told").replaceChildren(text(`The spectrum needs ${few(minute.segment_s)} s; ${few(seconds)} s are there${lost}.`));
    return;
  }
  const [unit, of] = UNITS[$("live-unit").value], kept = hz.map((_, k) => k).filter((k) => k > 0); // 0 Hz has no place on a logarithmic axis
  $("live-spectrum-told").replaceChildren(text(`Resolution ${few(minute.resolution_hz)} Hz (noise bandwidth of a Hann window); mean of ${minute.segments} half overlapping segments of ${few(minute.segment_s)} s, one-sided, from the last ${few(seconds)} s${lost}.`));
  plot("live-spectrum", `Power spectral density, ${unit}`, kept.map((k) => hz[k]), AXES.map((label, i) => ({ label, stroke: tones[i], values: kept.map((k) => of(density[i][k]) || null) })), { unit: ["Hz", unit], log: true });
}

export function start() {
  $("live").replaceChildren(
    make("h2", [], { id: "live-name" }),
    make("div", [
      make("button", "Show the signal", { type: "button", id: "live-go", click: () => (source ? ended("Stopped.") : begin()) }),
      make("label", ["Spectrum in ", make("select", Object.entries(UNITS).map(([name, [unit]]) => make("option", unit, { value: name })), { id: "live-unit", change: () => minute && drawMinute() })]),
    ], { class: "tools" }),
    make("p", [], { id: "live-told", role: "status" }),
    make("div", [], { id: "live-block", class: "plot", role: "group", "aria-label": "Newest block" }),
    make("div", [], { id: "live-minute", class: "plot", role: "group", "aria-label": "Last minute" }),
    make("div", [], { id: "live-spectrum", class: "plot", role: "group", "aria-label": "Spectrum" }),
    make("p", [], { id: "live-spectrum-told", class: "hint" }),
  );
  setInterval(listen, 1000);
  document.addEventListener("visibilitychange", () => { if (document.hidden && source) ended("Stopped, because nobody looked."); });
}

// Shows the sensor of the address, from when it is opened until it is left.
export function show() {
  if (of === placeOfView().toString()) return;
  leave();
  begin();
}

export function leave() {
  if (!of) return;
  stop();
  of = "";
  minute = null;
  for (const { plot: drawn } of plots.values()) drawn.destroy();
  plots.clear();
}
