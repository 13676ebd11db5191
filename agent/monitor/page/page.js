// Which view is shown, who is logged in, and what changed.
import { leaveBench, showBench } from "./bench.js";
import { $, get, make, NeedsLogin, text, view } from "./common.js";
import { setUser } from "./commands.js";
import { showEvents, showFleet, startFleet } from "./fleet.js";
import { leaveSensor, showSensor, startSensor } from "./sensor.js";

const VIEWS = ["fleet", "sensor", "bench", "events"];
let told = null, me = { needs_login: false, user: "", verbs: [], token: "" }, changes = null, loading = false, again = false;

function go(given) {
  const next = view();
  for (const [name, value] of Object.entries(given)) value ? next.set(name, value) : next.delete(name);
  history.replaceState(null, "", `#${next}`);
  show();
}

async function show() {
  if (!told) return;
  const now = view(), chosen = now.has("sensor") ? "sensor" : VIEWS.includes(now.get("view")) ? now.get("view") : "fleet";
  for (const id of VIEWS) $(id).hidden = id !== chosen;
  for (const id of ["fleet", "bench", "events"]) id === chosen ? $(`to-${id}`).setAttribute("aria-current", "page") : $(`to-${id}`).removeAttribute("aria-current");
  document.title = `fieldcal: ${chosen === "sensor" ? now.get("sensor") : chosen}`;
  if (chosen !== "sensor") leaveSensor();
  if (chosen !== "bench") leaveBench();
  try {
    if (chosen === "sensor") await showSensor(told, go);
    else if (chosen === "bench") await showBench();
    else if (chosen === "events") showEvents(await get("api/events"));
    else if (chosen === "fleet") showFleet(told);
  } catch (error) {
    failed(error);
  }
}

function summary() {
  const need = told.sensors.filter((row) => row.why).length, gateways = told.gateways.filter((g) => g.why).length, bus = told.bus;
  return [
    `Sensors: ${told.sensors.length}, of which need a person: ${need}`, gateways ? `gateways: ${told.gateways.length}, of which need a person: ${gateways}` : "",
    bus.verifies ? "signatures are verified" : "signatures are not verified (option --keys)", bus.unconfirmed ? `${bus.unconfirmed} unconfirmed results` : "",
    bus.left_out ? `${bus.left_out} results beyond the limits are not shown` : "", bus.fault, bus.notices,
  ].filter(Boolean).join("; ");
}

const say = (words) => { if ($("summary").textContent !== words) $("summary").replaceChildren(text(words)); };

function failed(error) {
  if (error instanceof NeedsLogin) return logIn();
  say("the monitor does not answer");
  return undefined;
}

async function load() {
  if (loading) { again = true; return; }
  loading = true;
  try {
    told = await get("api/fleet");
    say(summary());
    await show();
  } catch (error) {
    failed(error);
  }
  loading = false;
  if (again) { again = false; setTimeout(load, 500); }
}

const showOpenBench = () => { if (told && !$("bench").hidden) showBench().catch(failed); };

function follow() {
  changes?.close();
  changes = new EventSource("api/changes");
  changes.onmessage = load;
  changes.addEventListener("bench", showOpenBench);
  changes.onerror = () => { say("the monitor does not answer"); if (changes.readyState === EventSource.CLOSED) setTimeout(begin, 2000); };
}

function logIn() {
  changes?.close();
  told = null;
  for (const id of VIEWS) $(id).hidden = true;
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
    say("the monitor does not answer");
    setTimeout(begin, 2000);
    return;
  }
  setUser(me);
  if (me.needs_login && !me.user) { logIn(); return; }
  $("login").hidden = true;
  $("user").replaceChildren(...(me.user ? [text(`${me.user} `), make("button", "Log out", { type: "button", click: logOut })] : []));
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
addEventListener("hashchange", show);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { leaveSensor(); leaveBench(); show(); });
startFleet(go);
startSensor(go);
setInterval(() => { if (told && !$("fleet").hidden) showFleet(told); }, 30000); // ages grow without a change
setInterval(showOpenBench, 5000); // so does the silence of a bench
begin();
