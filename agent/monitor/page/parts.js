// The parts of which the views are made: chips, counts, cards, small plots, bars.
import { make, text } from "./common.js";
import { finite } from "./format.js";

// What a sensor counts as (agent.monitor.fleet): its words, and its colour.
export const KINDS = {
  sound: ["in order", "ok"], drifting: ["drifting", "bad"], held: ["held", "warn"], silent: ["not heard", "off"],
  "no data": ["no data", "bad"], uncalibrated: ["not calibrated", "off"], gateway: ["gateway", "warn"],
};
export const chip = (kind) => make("span", KINDS[kind][0], { class: `chip ${KINDS[kind][1]}` });

// A count of a kind, which is a filter.
export const tile = (title, count, tone, pressed, click) => make("button", [make("b", count), make("span", title)], { type: "button", class: `tile ${tone}`, "aria-pressed": String(pressed), click });

export function copier(line) {
  const told = make("span", "", { role: "status", class: "hint" });
  const click = () => navigator.clipboard.writeText(line).then(() => told.replaceChildren(text("copied")), () => told.replaceChildren(text("select the line and copy it")));
  return make("div", [make("code", line, { tabindex: "0" }), make("button", "Copy", { type: "button", click, "aria-label": `Copy: ${line}` }), told], { class: "command" });
}

// A card of what needs a person. `say`: the sentence; `more`: what else is known; `steps`: what to do.
export function card({ kind, name, where, say, more, plot, steps }) {
  return make("article", [
    make("div", [make("h3", [name, " ", chip(kind)]), make("p", where, { class: "where" }), make("p", say, { class: "say" }), make("p", more, { class: "more" })]),
    make("div", plot, { class: "card-plot" }), make("div", [make("h4", "What to do"), ...steps], { class: "do" }),
  ], { class: `card need ${KINDS[kind][1]}` });
}

const SVG = "http://www.w3.org/2000/svg";
function drawn(tag, attributes) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  return element;
}

// A small plot. `curves`: [{t, v, u, tone}], u: half the band; `range`: [from, to, low, high]; `marks`: times.
export function spark(label, curves, [from, to, low, high], marks = [], height = 24) {
  const plot = drawn("svg", { viewBox: `0 0 100 ${height}`, preserveAspectRatio: "none", role: "img", "aria-label": label, class: "spark" });
  const x = (t) => (100 * (t - from)) / (to - from || 1), y = (v) => Math.min(height, Math.max(0, (height * (high - v)) / (high - low || 1)));
  const line = (points) => points.map(([a, b]) => `${x(a).toFixed(1)},${y(b).toFixed(1)}`).join(" ");
  plot.append(drawn("line", { x1: 0, x2: 100, y1: y(0), y2: y(0), class: "zero" }));
  for (const { t, v, u, tone } of curves) {
    const known = t.map((each, k) => [each, v[k], u?.[k]]).filter(([each, value]) => each >= from && finite(value));
    const edge = (sign) => known.map(([each, value, half]) => [each, value + sign * half]);
    if (u && known.every(([, , half]) => finite(half))) plot.append(drawn("polygon", { points: line([...edge(1), ...edge(-1).reverse()]), class: `band ${tone}` }));
    plot.append(drawn("polyline", { points: line(known), class: `curve ${tone}` }));
  }
  for (const t of marks) plot.append(drawn("line", { x1: x(t), x2: x(t), y1: 0, y2: height, class: "mark" }));
  return plot;
}

// Shares of a whole: [[title, share]].
export const bars = (shares) => make("dl", shares.flatMap(([title, share]) => {
  const bar = make("i"), percent = `${(100 * share).toFixed(share < 0.1 ? 1 : 0)} %`;
  bar.style.width = `${100 * share}%`;
  return [make("dt", title), make("dd", [make("span", percent), make("span", bar, { class: "bar", "aria-hidden": "true" })])];
}), { class: "bars" });
