// The parts of which the views are made: chips, counts, cards, small plots, bars. parts.html shows them all.
import { make, text } from "./common.js";
import { finite } from "./format.js";

// What a sensor counts as (agent.monitor.fleet): its words, its colour, and what they mean. The last three are of cards.
export const KINDS = {
  sound: ["in order", "ok", "Windows fit S and Q in force, and no drift and no step is found."],
  drifting: ["drifting", "bad", "The agent's test has found a slow change of S or Q. Whether S and Q in force follow it stands beside “values”."],
  changed: ["changed", "bad", "S or Q has changed at once, and S and Q in force follow: the change was adopted."],
  held: ["held", "warn", "New windows contradict S and Q in force, which stay: a person must look. Or an operator put it on hold."],
  suspected: ["suspected", "warn", "Of a sensor without a reference: the other sensors of its site say that its sensitivity or direction has changed. S and Q in force stay; U is enlarged until a visit."],
  silent: ["not heard", "off", "The gateway has left the bus, or three intervals passed without a result. What was taken down can be named in the configuration of the monitor."],
  retired: ["retired", "off", "It was taken down, says the configuration of the monitor. When it is heard again it is as any other."],
  "no data": ["no data", "bad", "The gateway gets no samples of the sensor."],
  uncalibrated: ["not calibrated", "off", "No calibration is in force yet."],
  doubled: ["two of one name", "bad", "Two gateways, as of a copied memory card, give results under one name, so nobody knows whose they are. A run is a gateway from its start to its end."],
  gateway: ["gateway", "warn", "The gateway itself needs a person."],
  structure: ["structure", "warn", "The sensors of a site say together that the structure has changed."],
  over: ["over", "off", "This no longer needs a person."],
};
export const chip = (kind) => make("span", KINDS[kind][0], { class: `chip ${KINDS[kind][1]}`, title: KINDS[kind][2] });

// A count of a kind, which is a filter.
export const tile = (title, count, tone, pressed, click) => make("button", [make("b", count), make("span", title)], { type: "button", class: `tile ${tone}`, "aria-pressed": String(pressed), click });

// Copies a line. A browser gives the clipboard to pages of https and of its own machine alone; elsewhere the line, which
// stands in `code`, is selected.
export async function copy(line, code, told) {
  try {
    await navigator.clipboard.writeText(line);
    told.replaceChildren(text("copied"));
  } catch {
    getSelection().selectAllChildren(code);
    told.replaceChildren(text(document.execCommand("copy") ? "copied" : "selected: copy it with Ctrl+C"));
  }
}

export function copier(line) {
  const told = make("span", "", { role: "status", class: "hint" }), code = make("code", line.split(" ").flatMap((word) => [" ", make("span", word)]).slice(1), { tabindex: "0" });
  return make("div", [code, make("button", "Copy", { type: "button", click: () => copy(line, code, told), "aria-label": `Copy: ${line}` }), told], { class: "command" });
}

// Whether values may be used, as words.js says it.
export const may = ([tone, sentence]) => make("p", sentence, { class: `may ${tone}` });

// A card of what needs a person. `say`: the sentence; `usable`: of its values; `more`: what else is known; `plot`:
// elements; null where there is none; `steps`: what to do.
export function card({ kind, name, where, say, usable, more, plot, steps }) {
  return make("article", [
    make("div", [make("h3", [name, " ", chip(kind)]), make("p", where, { class: "where" }), make("p", say, { class: "say" }), ...(usable ? [may(usable)] : []), make("p", more, { class: "more" })]),
    ...(plot ? [make("div", plot, { class: "card-plot" })] : []), make("div", [make("h4", "What to do:"), ...steps], { class: "do" }),
  ], { class: `card need ${KINDS[kind][1]}` });
}

const SVG = "http://www.w3.org/2000/svg";
function drawn(tag, attributes) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  return element;
}

// A small plot. `curves`: [{t, v, u, tone, dashed}], u: half the band; `range`: [from, to, low, high]; `marks`: times, as
// lines; `refused`: times of windows, as points at the lower edge.
export function spark(label, curves, [from, to, low, high], marks = [], height = 24, refused = []) {
  const plot = drawn("svg", { viewBox: `0 0 100 ${height}`, preserveAspectRatio: "none", role: "img", "aria-label": label, class: "spark" });
  const x = (t) => (100 * (t - from)) / (to - from || 1), y = (v) => Math.min(height, Math.max(0, (height * (high - v)) / (high - low || 1)));
  const line = (points) => points.map(([a, b]) => `${x(a).toFixed(1)},${y(b).toFixed(1)}`).join(" ");
  plot.append(drawn("line", { x1: 0, x2: 100, y1: y(0), y2: y(0), class: "zero" }));
  for (const { t, v, u, tone, dashed } of curves) {
    const points = t.map((each, k) => [each, v[k], u?.[k]]).filter(([each, value]) => each >= from && finite(value));
    // What is in force stays so until the next calibration.
    const known = dashed ? points : points.flatMap(([each, ...rest], k) => (k ? [[each, ...points[k - 1].slice(1)], [each, ...rest]] : [[each, ...rest]]));
    const edge = (sign) => known.map(([each, value, half]) => [each, value + sign * half]);
    if (u && known.every(([, , half]) => finite(half))) plot.append(drawn("polygon", { points: line([...edge(1), ...edge(-1).reverse()]), class: `band ${tone}` }));
    plot.append(drawn("polyline", { points: line(known), class: `curve ${tone}${dashed ? " dashed" : ""}` }));
  }
  for (const t of refused) plot.append(drawn("polygon", { points: `${x(t) - 0.8},${height} ${x(t) + 0.8},${height} ${x(t)},${height - 5}`, class: "refused" }));
  for (const t of marks) plot.append(drawn("line", { x1: x(t), x2: x(t), y1: 0, y2: height, class: "mark" }));
  return plot;
}

// Shares of a whole: [[title, share]].
export const bars = (shares) => make("dl", shares.flatMap(([title, share]) => {
  const bar = make("i"), percent = `${(100 * share).toFixed(share < 0.1 ? 1 : 0)} %`;
  bar.style.width = `${100 * share}%`;
  return [make("dt", title), make("dd", [make("span", percent), make("span", bar, { class: "bar", "aria-hidden": "true" })])];
}), { class: "bars" });
