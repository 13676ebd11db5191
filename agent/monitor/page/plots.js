// Plots by uPlot: quantities over time with bands of k = 2, all with the same range of time; and the response.
import { make } from "./common.js";
import { day, finite, signed } from "./format.js";

// What is in force stays so until the next calibration.
const stays = uPlot.paths.stepped({ align: 1 });

const WORDS_ROWS = 3, WORDS_PX = 14; // rows of words above a plot with marks

// A named value of page.css.
export const named = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
export const colours = () => ["--x", "--y", "--z"].map(named);
// Dates that are read alike everywhere, for steps of a year, of months, days, hours and minutes, and of seconds.
const DATES = [[31536000, "{YYYY}", null], [2419200, "{MMM}", "\n{YYYY}"], [86400, "{MMM} {D}", "\n{YYYY}"], [60, "{HH}:{mm}", "\n{MMM} {D} {YYYY}", null, "\n{MMM} {D}"], [1, ":{ss}", "\n{MMM} {D} {YYYY} {HH}:{mm}", null, "\n{MMM} {D} {HH}:{mm}", null, "\n{HH}:{mm}"]].map((given) => [...given, ...Array(8 - given.length).fill(null), 1]);
const MOMENT = "{MMM} {D} {YYYY} {HH}:{mm}";
const axisOf = () => ({ stroke: named("--mute"), grid: { stroke: named("--line"), width: 1 }, ticks: { stroke: named("--line"), width: 1 }, font: "12px system-ui, sans-serif" });
const width = (box) => box.clientWidth || 320;

export function boxOf(label) {
  return make("div", [], { role: "group", "aria-label": label, class: "plot" });
}

// Plots over time that all show the same range of it. A plot is {title, unit, height, series, marks, refused}; a series
// {label, values, u, tone, dashed}, u: standard uncertainties; a mark {t, text, alarm}; refused: times of windows.
export class TimePlots {
  constructor(onRange) {
    this.onRange = onRange;
    this.plots = [];
    this.range = null;
    this.setting = false;
  }

  // Draws them anew into the boxes; `times` in s of UTC.
  draw(times, drawn) {
    for (const plot of this.plots) plot.destroy();
    this.times = times;
    this.setting = true;
    this.plots = drawn.map(([box, one]) => this.made(one, times, box));
    this.setRange(this.range);
  }

  made(one, times, box) {
    const axis = axisOf(), series = [{ value: MOMENT }], data = [times], bands = [];
    for (const { label, values, u, tone, dashed } of one.series) {
      const colour = named(`--${tone}`), at = series.length;
      const paths = dashed ? undefined : stays;
      series.push({ label, stroke: colour, width: 2, paths, dash: dashed ? [5, 4] : undefined, points: { show: dashed || times.length < 60, size: 4 }, value: (_, v) => (v === null || v === undefined ? "–" : `${signed(v, one.digit)}${one.unit}`) });
      data.push(values);
      if (!u) continue;
      for (const k of [2, -2]) {
        series.push({ edge: true, stroke: "transparent", paths, points: { show: false } });
        data.push(values.map((v, j) => (finite(v) && finite(u[j]) ? v + k * u[j] : null)));
      }
      bands.push({ series: [at + 1, at + 2], fill: `${colour}1c` });
    }
    const marks = (one.marks ?? []).map(({ t, text }) => `${day(1e9 * t).textContent}: ${text}`); // a canvas tells nothing by itself
    box.setAttribute("aria-label", [`${one.title} over time`, ...marks].join("; "));
    box.replaceChildren();
    const above = one.marks?.length ? WORDS_ROWS * WORDS_PX : 0;
    const plot = new uPlot({
      width: width(box), height: one.height, cursor: { sync: { key: "time" }, y: false }, legend: { live: true },
      axes: [{ ...axis, values: DATES }, { ...axis, size: 62, values: (_, ticks) => ticks.map((v) => `${signed(v, 10 * (ticks[1] - ticks[0] || 1))}${one.unit}`) }],
      series, bands, padding: [12 + above, 12, null, null],
      scales: { y: { range: (_, low, high) => rangeOf(one, low, high) } },
      hooks: { draw: [(made) => drawMarks(made, one.marks ?? []), (made) => drawRefused(made, one.refused ?? [])], setScale: [(made, key) => key === "x" && this.zoomed(made)] },
    }, data, box);
    [...box.querySelectorAll(".u-series")].forEach((label, i) => { label.hidden = Boolean(series[i].edge); });
    return plot;
  }

  zoomed(plot) {
    const { min, max } = plot.scales.x, times = this.times;
    if (this.setting || min === undefined || times.length === 0) return;
    const all = min <= times[0] && max >= times.at(-1);
    this.setRange(all ? null : [min, max]);
    this.onRange(this.range);
  }

  // [from, to] in s of UTC; null: all.
  setRange(range) {
    this.range = range;
    this.setting = true;
    const times = this.times ?? [];
    for (const plot of times.length ? this.plots : []) plot.setScale("x", range ? { min: range[0], max: range[1] } : { min: times[0], max: times.at(-1) > times[0] ? times.at(-1) : times[0] + 1 });
    queueMicrotask(() => { this.setting = false; }); // uPlot tells of a new scale in a microtask
  }

  // A wider or narrower range, or one that is moved by a part of itself.
  move(factor, part) {
    const times = this.times ?? [];
    if (times.length < 2) return;
    const [from, to] = this.range ?? [times[0], times.at(-1)], half = ((to - from) / 2) * factor, middle = (from + to) / 2 + part * (to - from);
    this.setRange(middle - half <= times[0] && middle + half >= times.at(-1) ? null : [middle - half, middle + half]);
    this.onRange(this.range);
  }
}

// The range of a plot with values from `low` to `high`: it may cut a band that is far wider than nine tenths of it are.
function rangeOf({ series, digit }, low, high) {
  const ends = [-2, 2].map((k) => series.flatMap(({ values, u }) => values.map((v, j) => v + k * (u?.[j] ?? 0)).filter(finite)).sort((a, b) => k * (a - b)));
  const [least, most] = ends.map((sorted) => sorted[Math.floor(0.9 * (sorted.length - 1))] ?? 0), all = series.flatMap(({ values }) => values.filter(finite)), reach = most - least;
  const [from, to] = [Math.max(low, Math.min(least - reach, ...all)), Math.min(high, Math.max(most + reach, ...all))], margin = 0.05 * (to - from);
  return [Math.min(from - margin, -digit), Math.max(to + margin, digit)];
}

// Of words from `from` to `to` each, in px: the row above the plot in which none covers another; null where none is free.
export function rowsOf(words) {
  const rows = Array.from({ length: WORDS_ROWS }, () => []);
  return words.map((one) => {
    const row = rows.findIndex((there) => there.every((other) => one.to < other.from || one.from > other.to));
    if (row >= 0) rows[row].push(one);
    return row >= 0 ? row : null;
  });
}

// Dashed lines, with their words above the plot: where a drift or a step began, a reference was exchanged, the agent began
// anew. Where there is no room, the words of an alarm come first.
function drawMarks(plot, marks) {
  const { ctx, bbox } = plot, px = devicePixelRatio;
  ctx.save();
  ctx.setLineDash([6, 4]);
  ctx.lineWidth = px;
  ctx.font = `${11 * px}px system-ui, sans-serif`;
  const seen = marks.map((mark) => ({ ...mark, x: plot.valToPos(mark.t, "x", true) })).filter(({ x }) => x >= bbox.left && x <= bbox.left + bbox.width).sort((a, b) => Boolean(b.alarm) - Boolean(a.alarm));
  const words = seen.map(({ x, text }) => {
    const wide = ctx.measureText(text).width + 4 * px, from = Math.min(x, bbox.left + bbox.width - wide);
    return { from, to: from + wide };
  });
  const rows = rowsOf(words), top = (row) => bbox.top - (WORDS_ROWS - row) * WORDS_PX * px;
  seen.forEach(({ x, alarm }, i) => {
    ctx.strokeStyle = named(alarm ? "--bad" : "--mute");
    ctx.beginPath();
    ctx.moveTo(x, rows[i] === null ? bbox.top : top(rows[i]));
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
  });
  ctx.textAlign = "left";
  ctx.textBaseline = "middle";
  seen.forEach(({ text, alarm }, i) => {
    if (rows[i] === null) return;
    ctx.fillStyle = named("--card"); // no line crosses a word
    ctx.fillRect(words[i].from + px, top(rows[i]), words[i].to - words[i].from - px, (WORDS_PX - 1) * px);
    ctx.fillStyle = named(alarm ? "--bad" : "--mute");
    ctx.fillText(text, words[i].from + 3 * px, top(rows[i]) + 0.5 * WORDS_PX * px);
  });
  ctx.restore();
}

// A triangle at the lower edge for each window that is held.
function drawRefused(plot, times) {
  const { ctx, bbox } = plot, size = 4 * devicePixelRatio, low = bbox.top + bbox.height;
  ctx.fillStyle = named("--bad");
  for (const t of times) {
    const x = plot.valToPos(t, "x", true);
    if (x < bbox.left || x > bbox.left + bbox.width) continue;
    ctx.beginPath();
    ctx.moveTo(x - size, low);
    ctx.lineTo(x + size, low);
    ctx.lineTo(x, low - 2 * size);
    ctx.fill();
  }
}

// Curves {label, values, u} over one axis of x; `log`: a logarithmic axis of frequency; `time`: x is s of UTC.
export function curves(box, title, x, series, log, time = false, height = 240) {
  const axis = axisOf(), COLOURS = colours(), drawn = [time ? { value: MOMENT } : { label: "Hz" }], data = [x], bands = [];
  series.forEach((one, i) => {
    drawn.push({ label: one.label, stroke: COLOURS[i], width: one.u ? 2 : 1, points: { show: x.length < 60 } });
    data.push(one.values);
    if (!one.u) return;
    for (const k of [2, -2]) {
      drawn.push({ edge: true, stroke: "transparent", points: { show: false } });
      data.push(one.values.map((v, j) => v + k * one.u[j]));
    }
    bands.push({ series: [drawn.length - 2, drawn.length - 1], fill: `${COLOURS[i]}22` });
  });
  box.replaceChildren();
  const plot = new uPlot({ title, width: width(box), height, axes: [time ? { ...axis, values: DATES } : axis, { ...axis, size: 70 }], scales: { x: { time, distr: log ? 3 : 1 } }, series: drawn, bands, cursor: { drag: { setScale: !log } } }, data, box);
  [...box.querySelectorAll(".u-series")].forEach((label, i) => { label.hidden = Boolean(drawn[i].edge); });
  return plot;
}

// U after each stop on a logarithmic axis, with what is wanted as dashed lines.
export function descent(box, taken, wanted) {
  const axis = axisOf(), COLOURS = colours(), x = taken.map((_, i) => i + 1), kinds = [["main", "main_pct"], ["transverse", "transverse_pct"]];
  const series = kinds.flatMap(([kind], i) => [
    { label: `U (${kind}), %`, stroke: COLOURS[i], width: 2, points: { show: true } },
    { label: `wanted (${kind})`, stroke: COLOURS[i], dash: [6, 4], points: { show: false } }]);
  const data = [x, ...kinds.flatMap(([, key]) => [taken.map((t) => t.expanded[key]), x.map(() => wanted[key])])];
  return new uPlot({ title: "U (k = 2) after each stop, %", width: width(box), height: 220, axes: [{ ...axis, incrs: [1, 2, 5, 10, 20] }, { ...axis, size: 70 }],
    scales: { x: { time: false, range: (_, low, high) => [low - 0.2, high + 0.2] }, y: { distr: 3 } }, series: [{ label: "stop" }, ...series], legend: { live: false }, cursor: { drag: { x: false, y: false } } }, data, box);
}
