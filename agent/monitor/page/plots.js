// Plots by uPlot: quantities over time with bands of k = 2, all with the same range of time; and the response.
import { make } from "./common.js";

const GRID = "#8884";
export const COLOURS = ["#1a73e8", "#c2500a", "#00805e"];
const axisOf = () => ({ stroke: getComputedStyle(document.body).color, grid: { stroke: GRID }, ticks: { stroke: GRID } });
const width = (box) => box.clientWidth || 320;

export function boxOf(label) {
  return make("div", [], { role: "group", "aria-label": label, class: "plot" });
}

// Values over time with bands, one plot for each series {label, title, values, u, onsets}; u: standard uncertainties.
export class TimePlots {
  constructor(container, onRange) {
    this.container = container;
    this.onRange = onRange;
    this.plots = [];
    this.range = null;
    this.setting = false;
  }

  update(times, series) {
    const shown = times.length ? series : [];
    if (this.plots.length !== shown.length) {
      this.plots = [];
      this.container.replaceChildren(...shown.map((one) => boxOf(`${one.title} over time with its k = 2 band`)));
    }
    this.setting = true;
    shown.forEach((one, i) => {
      const shift = (k) => one.values.map((v, j) => (v === null || one.u[j] === null ? null : v + k * one.u[j]));
      const data = [times, shift(0), shift(2), shift(-2)];
      if (this.plots[i]) this.plots[i].setData(data, !this.range);
      else this.plots[i] = this.made(one, data, this.container.children[i]);
      this.plots[i].onsets = one.onsets ?? [];
      this.plots[i].redraw(false);
    });
    this.setting = false;
    this.setRange(this.range);
  }

  made(one, data, box) {
    const colour = COLOURS[0], axis = axisOf();
    return new uPlot({
      title: one.title, width: width(box), height: 200, cursor: { sync: { key: "time" } }, legend: { live: true },
      axes: [axis, { ...axis, size: 70 }],
      series: [{}, { label: one.label, stroke: colour, width: 2, points: { show: data[0].length < 60 } }, ...["+U", "-U"].map((label) => ({ label, stroke: `${colour}88`, points: { show: false } }))],
      bands: [{ series: [2, 3], fill: `${colour}33` }],
      hooks: { draw: [drawOnsets], setScale: [(plot, key) => key === "x" && this.zoomed(plot)] },
    }, data, box);
  }

  zoomed(plot) {
    const { min, max } = plot.scales.x, [times] = plot.data;
    if (this.setting || min === undefined || times.length === 0) return;
    const all = min <= times[0] && max >= times.at(-1);
    this.setRange(all ? null : [min, max]);
    this.onRange(this.range);
  }

  // [from, to] in s of UTC; null: all.
  setRange(range) {
    this.range = range;
    this.setting = true;
    for (const plot of this.plots) {
      const times = plot.data[0];
      if (times.length) plot.setScale("x", range ? { min: range[0], max: range[1] } : { min: times[0], max: times.at(-1) > times[0] ? times.at(-1) : times[0] + 1 });
    }
    queueMicrotask(() => { this.setting = false; }); // uPlot tells of a new scale in a microtask
  }
}

// A dashed line where a drift or a step began.
function drawOnsets(plot) {
  const { ctx, bbox } = plot;
  ctx.save();
  ctx.strokeStyle = getComputedStyle(document.documentElement).getPropertyValue("--alarm");
  ctx.setLineDash([6, 4]);
  ctx.lineWidth = 2;
  for (const onset of plot.onsets ?? []) {
    const x = plot.valToPos(onset, "x", true);
    if (x < bbox.left || x > bbox.left + bbox.width) continue;
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
  }
  ctx.restore();
}

// Curves {label, values, u} over one axis of x; `log`: a logarithmic axis of frequency; `time`: x is s of UTC.
export function curves(box, title, x, series, log, time = false) {
  const axis = axisOf(), drawn = [{}], data = [x], bands = [];
  series.forEach((one, i) => {
    drawn.push({ label: one.label, stroke: COLOURS[i], width: one.u ? 2 : 1, points: { show: x.length < 60 } });
    data.push(one.values);
    if (!one.u) return;
    for (const k of [2, -2]) {
      drawn.push({ label: `${one.label} ${k > 0 ? "+" : "-"}U`, stroke: `${COLOURS[i]}66`, points: { show: false } });
      data.push(one.values.map((v, j) => v + k * one.u[j]));
    }
    bands.push({ series: [drawn.length - 2, drawn.length - 1], fill: `${COLOURS[i]}22` });
  });
  box.replaceChildren();
  return new uPlot({ title, width: width(box), height: 240, axes: [axis, { ...axis, size: 70 }], scales: { x: { time, distr: log ? 3 : 1 } }, series: drawn, bands, cursor: { drag: { setScale: !log } } }, data, box);
}

// U after each stop on a logarithmic axis, with what is wanted as dashed lines.
export function descent(box, taken, wanted) {
  const axis = axisOf(), x = taken.map((_, i) => i + 1), kinds = [["main", "main_pct"], ["transverse", "transverse_pct"]];
  const series = kinds.flatMap(([kind], i) => [
    { label: `U (${kind}), %`, stroke: COLOURS[i], width: 2, points: { show: true } },
    { label: `wanted (${kind})`, stroke: COLOURS[i], dash: [6, 4], points: { show: false } }]);
  const data = [x, ...kinds.flatMap(([, key]) => [taken.map((t) => t.expanded[key]), x.map(() => wanted[key])])];
  return new uPlot({ title: "U (k = 2) after each stop, %", width: width(box), height: 220, axes: [{ ...axis, incrs: [1, 2, 5, 10, 20] }, { ...axis, size: 70 }],
    scales: { x: { time: false, range: (_, low, high) => [low - 0.2, high + 0.2] }, y: { distr: 3 } }, series: [{ label: "stop" }, ...series], legend: { live: false }, cursor: { drag: { x: false, y: false } } }, data, box);
}
