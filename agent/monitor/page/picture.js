// PNG pictures of a view, drawn on a canvas.
const MARGIN = 12, LINE = 18, COLUMN_MAX = 420;

function canvasOf(width, height) {
  const canvas = document.createElement("canvas"), style = getComputedStyle(document.body);
  Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d");
  context.fillStyle = style.backgroundColor;
  context.fillRect(0, 0, width, height);
  Object.assign(context, { fillStyle: style.color, strokeStyle: style.color, font: "13px system-ui, sans-serif", textBaseline: "top" });
  return [canvas, context];
}

function save(canvas, name) {
  canvas.toBlob((blob) => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  });
}

function fitted(context, words, width) {
  if (context.measureText(words).width <= width) return words;
  let shown = words;
  while (shown && context.measureText(`${shown}…`).width > width) shown = shown.slice(0, -1);
  return `${shown}…`;
}

// A table as it is shown.
export function saveTable(table, name) {
  const rows = [...table.rows].map((row) => [...row.cells].map((cell) => cell.textContent));
  const [, measured] = canvasOf(1, 1);
  const widths = rows[0].map((_, i) => Math.min(COLUMN_MAX, Math.max(...rows.map((row) => measured.measureText(row[i]).width))));
  const [canvas, context] = canvasOf(widths.reduce((a, b) => a + b + MARGIN, MARGIN), MARGIN * 2 + LINE * rows.length);
  rows.forEach((row, y) => {
    let x = MARGIN;
    row.forEach((cell, i) => {
      context.fillText(fitted(context, cell, widths[i]), x, MARGIN + LINE * y);
      x += widths[i] + MARGIN;
    });
  });
  save(canvas, name);
}

// All plots of a view, in two columns, each under its title.
export function savePlots(boxes, title, name) {
  const drawn = boxes.map((box) => [box.getAttribute("aria-label"), box.querySelector("canvas")]).filter(([, canvas]) => canvas);
  const width = Math.max(...drawn.map(([, canvas]) => canvas.width)), height = Math.max(...drawn.map(([, canvas]) => canvas.height)) + LINE;
  const [canvas, context] = canvasOf(2 * width + 3 * MARGIN, LINE + Math.ceil(drawn.length / 2) * (height + MARGIN) + 2 * MARGIN);
  context.fillText(title, MARGIN, MARGIN);
  drawn.forEach(([label, plot], i) => {
    const x = MARGIN + (i % 2) * (width + MARGIN), y = MARGIN + LINE + Math.floor(i / 2) * (height + MARGIN);
    context.fillText(label, x, y);
    context.drawImage(plot, x, y + LINE);
  });
  save(canvas, name);
}
