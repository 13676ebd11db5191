// The plan view: the picture of the structure with the sensors on it, and where a person with the right puts them.
import { $, clean, full, get, make, NeedsLogin, placeOf, text } from "./common.js";
import { KINDS } from "./parts.js";

const AGAIN_MS = 10000; // other people may change the plan; a change of the fleet comes far more often
const STEP = 0.01, SAVE_MS = 400; // of an arrow key, in parts of the picture; after the last one
const LARGEST = 8e6; // bytes

let rows = [], me = { verbs: [], token: "" }, plan = null, askedAt = 0, arranging = false, chosen = "";
const waiting = new Map(); // sensors that were moved: the timer until the monitor keeps it

const say = (words) => $("plan-told").replaceChildren(text(words));

async function send(path, body, type) {
  const answer = await fetch(path, { method: "POST", headers: { "Content-Type": type, "X-CSRF-Token": me.token }, body });
  if (answer.status === 401) throw new NeedsLogin();
  if (!answer.ok) throw new Error(await answer.text());
}

async function keep(place) {
  waiting.delete(place);
  try {
    await send("api/plan/position", JSON.stringify({ place, at: plan.positions[place] ?? null }), "application/json");
    say(plan.positions[place] ? `${place} is kept` : `${place} is off the plan`);
  } catch (error) {
    say(`not kept: ${error.message || "log in again"}`);
  }
}

function put(place, at, delay = 0) {
  if (at) plan.positions[place] = at.map((part) => Math.min(1, Math.max(0, part)));
  else delete plan.positions[place];
  clearTimeout(waiting.get(place));
  waiting.set(place, setTimeout(keep, delay, place));
  draw();
}

async function takePicture(file) {
  if (!file) return;
  if (file.size > LARGEST) { say(`${file.name} has ${(file.size / 1e6).toFixed(1)} MB, at most 8 MB are taken; make it smaller`); return; }
  try {
    await send("api/plan/picture", file, "application/octet-stream");
    say("the picture is kept");
    await load();
  } catch (error) {
    say(`not kept: ${error.message || "log in again"}`);
  }
}

function press(event, place) {
  const at = plan.positions[place], by = { ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, -STEP], ArrowDown: [0, STEP] }[event.key];
  if (!arranging || !at || !(by || event.key === "Delete")) return;
  event.preventDefault();
  by ? put(place, [at[0] + by[0], at[1] + by[1]], SAVE_MS) : put(place, null);
}

function place(event) {
  const box = $("plan-picture").getBoundingClientRect();
  return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
}

// A point is dragged while the picture hears where the pointer is.
function drag(event, name) {
  if (!arranging) return;
  event.preventDefault();
  choose(name);
  const move = (moved) => put(name, place(moved), SAVE_MS), end = () => { removeEventListener("pointermove", move); removeEventListener("pointerup", end); };
  addEventListener("pointermove", move);
  addEventListener("pointerup", end);
}

function choose(name) {
  chosen = name;
  $("plan-sensor").value = name;
}

// The points stay the same elements while data come, so that none is rebuilt under a person's hands.
const points = new Map();

function point(row, label) {
  const name = full(row), [title, tone] = KINDS[row.kind], words = `${name}: ${title}${row.why ? `, ${row.why}` : ""}`;
  if (!points.has(name)) {
    const made = make("a", [make("span")], { href: `#${placeOf(row)}`, draggable: "false", click: (event) => arranging && event.preventDefault(), keydown: (event) => press(event, name), pointerdown: (event) => drag(event, name) });
    points.set(name, made);
  }
  const made = points.get(name), [x, y] = plan.positions[name];
  made.className = `point ${tone}`;
  made.firstChild.textContent = clean(label);
  made.title = words;
  made.setAttribute("aria-label", words);
  made.style.left = `${100 * x}%`;
  made.style.top = `${100 * y}%`;
  return made;
}

const SIDES = ["right", "left", "above", "below"];
const RADIUS_PX = 11, APART_PX = 2; // of a point; between names
const TONES = ["bad", "warn", "off"]; // whose names are shown, the first ones first

function boxBeside([x, y], [width, height], side) {
  const left = { right: x + RADIUS_PX, left: x - RADIUS_PX - width }[side] ?? x - width / 2, top = { above: y - RADIUS_PX - height, below: y + RADIUS_PX }[side] ?? y - height / 2;
  return [left, top, left + width, top + height];
}

// Each name stands on the first side of its point where it covers no point, no name and no edge. Where there is no such side
// it is shown when a person points at its point.
function arrangeNames() {
  const picture = $("plan-picture"), width = picture.clientWidth, height = picture.clientHeight, rank = (one) => TONES.indexOf(one.classList[1]);
  const all = [...points].filter(([, one]) => one.isConnected).map(([name, one]) => ({ one, at: [plan.positions[name][0] * width, plan.positions[name][1] * height] }));
  for (const { one, at: [x] } of all) { one.dataset.side = x > width / 2 ? "left" : "right"; one.classList.remove("quiet"); }
  const named = all.filter(({ one }) => rank(one) >= 0).sort((a, b) => rank(a.one) - rank(b.one)).map((each) => ({ ...each, size: [each.one.firstChild.offsetWidth, each.one.firstChild.offsetHeight] }));
  const taken = all.map(({ at: [x, y] }) => [x - RADIUS_PX, y - RADIUS_PX, x + RADIUS_PX, y + RADIUS_PX]);
  const free = ([left, top, right, bottom]) => left >= 0 && top >= 0 && right <= width && bottom <= height && taken.every((other) => right <= other[0] || left >= other[2] || bottom <= other[1] || top >= other[3]);
  for (const { one, at, size } of named) {
    const side = SIDES.find((each) => free(boxBeside(at, size, each))), [left, top, right, bottom] = boxBeside(at, size, side);
    one.classList.toggle("quiet", !side);
    if (side) { one.dataset.side = side; taken.push([left - APART_PX, top - APART_PX, right + APART_PX, bottom + APART_PX]); }
  }
}

function draw() {
  const placed = rows.filter((row) => plan.positions[full(row)]), may = me.verbs.includes("plan");
  $("plan-tools").hidden = !may;
  $("plan-empty").hidden = Boolean(plan.picture);
  $("plan-picture").hidden = !plan.picture;
  $("plan-arrange").setAttribute("aria-pressed", arranging);
  $("plan-which").hidden = $("plan-off").hidden = $("plan-hint").hidden = !arranging;
  $("plan-picture").classList.toggle("arranging", arranging);
  const alone = (row) => placed.filter((one) => one.sensor === row.sensor).length === 1;
  const shown = placed.map((row) => point(row, alone(row) ? row.sensor : `${row.gateway} / ${row.sensor}`)), there = [...$("plan-picture").querySelectorAll(".point")];
  for (const old of there) if (!shown.includes(old)) old.remove();
  $("plan-picture").append(...shown.filter((one) => !there.includes(one)));
  arrangeNames();
  const kinds = Object.keys(KINDS).filter((kind) => placed.some((row) => row.kind === kind));
  $("plan-legend").replaceChildren(...kinds.map((kind) => make("span", [make("i", [], { class: `point ${KINDS[kind][1]}`, "aria-hidden": "true" }), `${placed.filter((row) => row.kind === kind).length} ${KINDS[kind][0]}`])), make("span", `${rows.length - placed.length} not on the plan`));
  const names = rows.map(full).sort((a, b) => Boolean(plan.positions[a]) - Boolean(plan.positions[b]) || a.localeCompare(b)), key = JSON.stringify(names);
  if (arranging && $("plan-sensor").dataset.names !== key) {
    $("plan-sensor").replaceChildren(...names.map((name) => make("option", plan.positions[name] ? name : `${name} (not on the plan)`, { value: name })));
    $("plan-sensor").dataset.names = key;
    choose(names.includes(chosen) ? chosen : names[0] ?? "");
  }
}

async function load() {
  const before = plan?.picture;
  [plan, me] = await Promise.all([get("api/plan"), get("api/me")]);
  if (plan.picture && plan.picture !== before) {
    $("plan-picture").querySelector("img")?.remove();
    $("plan-picture").prepend(make("img", [], { src: `plan?version=${plan.picture}`, alt: "Plan of the structure", draggable: "false" }));
  }
}

export function start() {
  const file = make("input", [], { type: "file", id: "plan-file", accept: "image/png,image/jpeg", change: (event) => takePicture(event.target.files[0]).then(draw) });
  const sensor = make("select", [], { id: "plan-sensor", change: (event) => { chosen = event.target.value; points.get(chosen)?.focus(); } });
  $("plan").replaceChildren(
    make("div", [make("h2", "Plan")], { class: "tools" }),
    make("p", [], { id: "plan-legend" }),
    make("div", [
      make("label", ["Picture (PNG or JPEG, 8 MB at most) ", file]),
      make("button", "Arrange sensors", { type: "button", id: "plan-arrange", "aria-pressed": "false", click: () => { arranging = !arranging; draw(); } }),
      make("label", ["Sensor ", sensor], { id: "plan-which" }),
      make("button", "Take it off", { type: "button", id: "plan-off", click: () => chosen && put(chosen, null) }),
    ], { class: "tools", id: "plan-tools", hidden: true }),
    make("p", "Choose a sensor and click in the picture, or drag a point. Arrow keys move the point that has the focus, Delete takes it off.", { class: "hint", id: "plan-hint", hidden: true }),
    make("p", [], { id: "plan-told", role: "status" }),
    make("p", "There is no plan yet. A user with the right “plan” puts a picture of the structure here; docs/fleet.md says how.", { id: "plan-empty", hidden: true }),
    make("div", [], { id: "plan-picture", hidden: true, click: (event) => arranging && chosen && event.target.tagName === "IMG" && put(chosen, place(event)) }),
  );
  new ResizeObserver(arrangeNames).observe($("plan-picture"));
}

export async function show(told) {
  rows = told.sensors;
  if (!plan || (!waiting.size && Date.now() - askedAt > AGAIN_MS)) {
    askedAt = Date.now();
    await load();
  }
  draw();
}

export function leave() {
  arranging = false;
  askedAt = 0;
}
