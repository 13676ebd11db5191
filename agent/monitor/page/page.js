// Which view is shown, who is logged in, and what changed.
import * as bench from "./bench.js";
import { $, full, get, make, NeedsLogin, text, view } from "./common.js";
import { setUser } from "./commands.js";
import * as events from "./events.js";
import * as fleet from "./fleet.js";
import { clockTime, duration, setNow } from "./format.js";
import * as live from "./live.js";
import { chip, KINDS } from "./parts.js";
import * as plan from "./plan.js";
import * as sensor from "./sensor.js";

// Each view is a module, and the element with its name as id. `#view=NAME&...` chooses it; what follows is its own:
// `#view=live&site=S&gateway=G&sensor=N`. Without a view it is the sensor that the address names, or else the fleet.
// A module has `show(told, go)`, called whenever the address or the fleet has changed; and where it needs them
// `start(go)`, called once, and `leave()`, called when another view is shown. `told` is the answer of api/fleet, `go`
// changes the parameters of the address.
const VIEWS = { fleet, sensor, plan, live, bench, events };
const OLD_S = 120; // from which the age of the last result is told
const HEARD_MS = 40000; // the monitor says something each 15 s
let told = null, me = { needs_login: false, user: "", verbs: [], token: "" }, changes = null, following = false, loading = false, again = false, lost = "", heardAt = 0;

function go(given) {
  const next = view();
  for (const [name, value] of Object.entries(given)) value ? next.set(name, value) : next.delete(name);
  history.replaceState(null, "", `#${next}`);
  show();
}

function chosenView(now) {
  if (Object.hasOwn(VIEWS, now.get("view"))) return now.get("view");
  return now.has("sensor") ? "sensor" : "fleet";
}

async function show() {
  if (!told) return;
  const now = view(), chosen = chosenView(now);
  for (const id of Object.keys(VIEWS)) {
    $(id).hidden = id !== chosen;
    id === chosen ? $(`to-${id}`)?.setAttribute("aria-current", "page") : $(`to-${id}`)?.removeAttribute("aria-current");
    if (id !== chosen) VIEWS[id].leave?.();
  }
  document.title = `fieldcal: ${now.get("sensor") ?? chosen}`;
  try {
    await VIEWS[chosen].show(told, go);
  } catch (error) {
    failed(error);
  }
}

function summary() {
  const bus = told.bus, need = told.sensors.filter((row) => row.kind !== "sound" && row.kind !== "retired").length;
  return [
    `Sensors: ${told.sensors.length}`, need ? `${need} not in order` : "all in order", bus.verifies ? "signatures verified" : "signatures not verified (option --keys)",
    bus.unconfirmed ? `${bus.unconfirmed} unconfirmed results` : "", bus.left_out ? `${bus.left_out} results beyond the limits are not shown` : "",
    bus.last_result_age_s > OLD_S ? `no result for ${duration(bus.last_result_age_s * 1e9)}` : "", bus.fault, bus.notices,
  ].filter(Boolean).join("; ");
}

const say = (words) => { if ($("summary").textContent !== words) $("summary").replaceChildren(text(words)); };

function failed(error) {
  if (error instanceof NeedsLogin) return logIn();
  return silent();
}

// What is shown then is old, and looks so.
function silent() {
  lost ||= clockTime();
  say(`the monitor does not answer since ${lost}${told ? "; what is shown is of then" : ""}`);
  document.querySelector("main").classList.toggle("old", Boolean(told));
}

// The rows that have changed, put into those that are known; all of them after a new begin.
function joined(answer) {
  setNow(answer.now_utc_ns);
  const rows = new Map((told?.sensors ?? []).map((row) => [full(row), row])), many = rows.size;
  for (const row of answer.sensors) rows.set(full(row), row);
  const sensors = [...rows.values()], reached = new Map(answer.gateways.map((g) => [`${g.site}/${g.gateway}`, g.told_utc_ns]));
  for (const row of sensors) row.gateway_utc_ns = reached.get(`${row.site}/${row.gateway}`);
  if (rows.size !== many) sensors.sort((a, b) => (full(a) < full(b) ? -1 : 1));
  return { ...answer, sensors };
}

async function load() {
  if (loading) { again = true; return; }
  loading = true;
  try {
    told = joined(await get(`api/fleet?since=${told?.version ?? 0}`));
    lost = "";
    document.querySelector("main").classList.remove("old");
    say(summary());
    await show();
  } catch (error) {
    failed(error);
  }
  loading = false;
  if (again) { again = false; setTimeout(load, 500); }
}

const showOpenBench = () => { if (told && !$("bench").hidden) bench.show().catch(failed); };

const hearing = (then) => () => { heardAt = performance.now(); then(); };

// A browser opens six connections to one server for all its pages together. So a page that nobody sees gives its own back.
function follow() {
  changes?.close();
  if (document.hidden || !following) return;
  heardAt = performance.now();
  changes = new EventSource("api/changes");
  changes.onmessage = hearing(load);
  changes.addEventListener("bench", hearing(showOpenBench));
  changes.addEventListener("alive", hearing(() => lost && load()));
  changes.onerror = beginAnew;
}

function beginAnew() {
  silent();
  following = false;
  changes.close();
  setTimeout(begin, 2000);
}

// A connection may end without a word: the computer sleeps, a router forgets it, the monitor hangs.
function listen() {
  if (following && !document.hidden && performance.now() - heardAt > HEARD_MS) beginAnew();
}

function logIn() {
  following = false;
  follow();
  told = null;
  for (const id of Object.keys(VIEWS)) $(id).hidden = true;
  $("user").replaceChildren();
  $("login").hidden = false;
  say("log in to see the fleet");
}

async function logOut() {
  await fetch("api/logout", { method: "POST" });
  await begin();
}

async function begin() {
  try {
    me = await get("api/me");
  } catch {
    silent();
    setTimeout(begin, 2000);
    return;
  }
  setUser(me);
  if (me.needs_login && !me.user) { logIn(); return; }
  $("login").hidden = true;
  $("user").replaceChildren(...(me.user ? [text(`${me.user} `), make("button", "Log out", { type: "button", click: logOut })] : []));
  told = null; // the monitor may be another one
  following = true;
  follow();
  await load();
}

$("login").addEventListener("submit", async (event) => {
  event.preventDefault();
  const fields = $("login").elements, given = { name: fields.name.value, password: fields.password.value };
  const answer = await fetch("api/login", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(given) });
  fields.password.value = "";
  $("login-told").replaceChildren(text(answer.ok ? "" : await answer.text()));
  if (answer.ok) await begin();
});
// A view that a person opens by a link begins at its top; the browser keeps the place of one to which a person goes back.
let opened = "";
addEventListener("click", (event) => { opened = event.target.closest?.("a")?.hash ?? ""; });
addEventListener("hashchange", () => {
  if (opened && opened === location.hash) scrollTo(0, 0);
  opened = "";
  show();
});
document.addEventListener("visibilitychange", follow);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { sensor.leave(); bench.leave(); show(); });
for (const one of Object.values(VIEWS)) one.start?.(go);
$("meanings").append(...Object.entries(KINDS).flatMap(([kind, [, , meaning]]) => [make("dt", chip(kind)), make("dd", meaning)]));
$("zone").textContent = Intl.DateTimeFormat().resolvedOptions().timeZone;
setInterval(() => { if (told && !$("fleet").hidden) fleet.show(told, go); }, 30000); // ages grow without a change
setInterval(listen, 5000);
setInterval(showOpenBench, 5000); // so does the silence of a bench
begin();
