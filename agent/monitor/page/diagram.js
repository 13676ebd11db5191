// The rows of S in space, as Figure 6 of the paper draws them: without transverse sensitivities each would lie on its axis.
import { colours } from "./plots.js";

const SIZE = 320, TURN = (38 * Math.PI) / 180, TILT = (22 * Math.PI) / 180;

// x points to the left below, y to the right, z upwards.
function project([x, y, z]) {
  const across = -x * Math.sin(TURN) + y * Math.cos(TURN), deep = x * Math.cos(TURN) + y * Math.sin(TURN);
  return [across, -(z * Math.cos(TILT) - deep * Math.sin(TILT))];
}

export function drawRows(canvas, S) {
  const ratio = devicePixelRatio || 1, context = canvas.getContext("2d"), COLOURS = colours(), reach = 1.2 * Math.max(...S.map((row, i) => Math.abs(row[i] ?? 0)));
  Object.assign(canvas, { width: SIZE * ratio, height: SIZE * ratio });
  const place = (vector) => project(vector.map((v) => (v ?? 0) / (reach || 1))).map((v) => (SIZE / 2 + 0.45 * SIZE * v) * ratio);
  const line = (from, to, colour, dash = []) => {
    context.strokeStyle = colour;
    context.setLineDash(dash.map((d) => d * ratio));
    context.beginPath();
    context.moveTo(...place(from));
    context.lineTo(...place(to));
    context.stroke();
  };
  const ink = getComputedStyle(document.body).color;
  context.lineWidth = ratio;
  context.font = `${14 * ratio}px system-ui, sans-serif`;
  ["x", "y", "z"].forEach((name, i) => {
    const end = [0, 0, 0].map((_, j) => (i === j ? reach : 0));
    line([0, 0, 0], end, ink);
    context.fillStyle = ink;
    context.fillText(name, ...place(end.map((v) => 1.06 * v)));
  });
  context.lineWidth = 2 * ratio;
  S.forEach((row, i) => {
    const ideal = row.map((v, j) => (i === j ? v : 0));
    line([0, 0, 0], row, COLOURS[i]);
    line(ideal, row, COLOURS[i], [3, 3]);
    context.fillStyle = COLOURS[i];
    context.beginPath();
    context.arc(...place(row), 4 * ratio, 0, 2 * Math.PI);
    context.fill();
  });
}
