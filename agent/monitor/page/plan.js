// The plan view: the picture of the structure with the sensors on it.
import { $, full, make, placeOf } from "./common.js";

// Sensors as points on the picture of the structure. Positions are fractions of its width and height.
export function show(told) {
  const plan = told.plan, rows = told.sensors;
  $("no-plan").hidden = Boolean(plan);
  if (!plan) return;
  const points = rows.filter((row) => plan[full(row)]).map((row) => {
    const [x, y] = plan[full(row)], point = make("a", "", { href: `#${placeOf(row)}`, class: row.why ? "point alarm" : "point", title: `${full(row)}: ${row.why || row.status}`, "aria-label": `${full(row)}: ${row.why || row.status}` });
    point.style.left = `${100 * x}%`;
    point.style.top = `${100 * y}%`;
    return point;
  });
  const picture = $("plan-picture").firstChild ?? make("img", [], { src: "plan", alt: "Plan of the structure" });
  $("plan-picture").replaceChildren(picture, ...points);
}
