// Commands to one sensor: a dialog shows the command line, or signs and sends the command for those with the right.
import { $, make, text } from "./common.js";
import * as signing from "./signing.js";

const WHAT = {
  accept: "The estimate comes into force.",
  rollback: "The earlier calibration comes into force again.",
  pose: "The sensor has this position from now on.",
  hold: "The calibration in force stays unchanged until it is released.",
  release: "The hold ends.",
};
let me = { user: "", verbs: [], token: "" };
export const setUser = (told) => { me = told; };

const OPTIONS = { theta_deg: "theta-deg", alpha_deg: "alpha-deg", direction: "direction", gravity_mps2: "gravity", position: "position", sequence: "sequence" };

export function commandLine(order) {
  const given = Object.entries(order.arguments).map(([name, value]) => (name === "release" ? "--release" : `--${OPTIONS[name]} ${[value].flat().join(" ")}`));
  return ["fieldcal command", order.verb, ...given, `--sensor ${order.sensor} --gateway ${order.gateway} --key KEY --connect ENDPOINT`].join(" ");
}

async function keyList(chosen) {
  const keys = signing.available() ? await signing.keys() : [];
  return make("select", keys.map((key) => make("option", key.id, { value: key.id, selected: key.id === chosen })), { id: "key" });
}

async function send(order, id, told) {
  told.replaceChildren(text("sending"));
  try {
    const [site, gateway] = order.gateway.split("/");
    const address = new URLSearchParams({ site, gateway, sensor: order.sensor, verb: order.verb });
    const answer = await fetch(`api/command?${address}`, { method: "POST", headers: { "X-CSRF-Token": me.token }, body: await signing.sign(order, id) });
    const said = answer.ok ? await answer.json() : { taken: false, reason: await answer.text() };
    told.replaceChildren(text(said.taken ? "taken by the gateway" : `refused: ${said.reason}`));
  } catch (error) {
    told.replaceChildren(text(`not sent: ${error.message}`));
  }
}

// Opens the dialog for an order {gateway, sensor, verb, arguments}.
export async function open(order) {
  const told = make("p", [], { role: "status", id: "told" }), line = commandLine(order), keys = await keyList();
  const may = me.verbs.includes(order.verb), ready = may && keys.options.length > 0;
  const hint = !me.user ? "Log in to send it from here; or run this line on a machine with your key:"
    : !may ? `${me.user} has no right to send ${order.verb} from here. With a key of your own, run:`
      : !signing.available() ? "A browser signs only on pages of HTTPS or localhost. Run this line instead:"
        : !ready ? "This browser has no key yet; make one under Keys. Or run this line:" : "Or run this line on a machine with your key:";
  const button = make("button", "Sign and send", { type: "button", disabled: !ready, click: () => send(order, keys.value, told) });
  $("order").replaceChildren(
    make("h2", `${order.arguments.release ? "release" : order.verb}: ${order.sensor} of ${order.gateway}`, { id: "order-title" }),
    make("p", WHAT[order.arguments.release ? "release" : order.verb]),
    ...(ready ? [make("p", [make("label", ["Key ", keys]), " ", button])] : []), told, make("p", hint), make("p", make("code", line)),
    make("p", [make("button", "Copy", { type: "button", click: () => copy(line, told) }), " ",
      make("button", "Close", { type: "button", click: () => $("order").close() })]));
  $("order").showModal();
}

async function copy(line, told) {
  try {
    await navigator.clipboard.writeText(line);
    told.replaceChildren(text("copied"));
  } catch {
    told.replaceChildren(text("this browser does not copy; select the line"));
  }
}

export const opener = (title, order) => make("button", title, { type: "button", click: () => open(order) });

function numbers(form, names) {
  const given = names.map((name) => form.elements[name].value.trim());
  if (given.every((value) => value === "")) return undefined;
  if (given.some((value) => value === "" || !Number.isFinite(Number(value)))) throw new RangeError(`${names.join(", ")}: give numbers for all of them, or for none`);
  return given.map(Number);
}

function poseOf(form) {
  const angles = numbers(form, ["theta", "alpha"]);
  const found = { theta_deg: angles?.[0], alpha_deg: angles?.[1], direction: numbers(form, ["dx", "dy", "dz"]), gravity_mps2: numbers(form, ["gx", "gy", "gz"]), position: form.elements.position.value.trim() || undefined };
  return Object.fromEntries(Object.entries(found).filter(([, value]) => value !== undefined));
}

export function poseForm(gateway, sensor) {
  const told = make("p", [], { role: "alert" });
  const field = (name, title) => make("label", [`${title} `, make("input", [], { name, inputmode: "decimal", size: "7" })]);
  const group = (title, ...fields) => make("fieldset", [make("legend", title), ...fields]);
  const form = make("form", [
    group("Clamp angles, deg", field("theta", "theta"), field("alpha", "alpha")),
    group("or direction of the motion", field("dx", "x"), field("dy", "y"), field("dz", "z")),
    group("gravity, m/s² (alone: a rest)", field("gx", "x"), field("gy", "y"), field("gz", "z")),
    make("label", ["Name of the position ", make("input", [], { name: "position" })]), " ",
    make("button", "State the position", { type: "submit" }), told], { class: "pose" });
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    try {
      told.replaceChildren();
      const given = poseOf(form);
      if (!given.direction && !given.gravity_mps2 && given.theta_deg === undefined) throw new RangeError("give angles, or a direction, or gravity");
      open({ gateway, sensor, verb: "pose", arguments: given });
    } catch (error) {
      told.replaceChildren(text(error.message));
    }
  });
  return form;
}

// The keys of this browser.
export async function keysSection() {
  if (!signing.available()) return [make("p", "A browser signs only on pages of HTTPS or localhost.")];
  const box = make("div"), told = make("p", [], { role: "status" });
  const refresh = async () => {
    const rows = (await signing.keys()).map((key) => make("li", [make("strong", key.id), " public key ", make("code", key.publicKey), " ",
      make("button", `Forget ${key.id}`, { type: "button", click: () => act(() => signing.forget(key.id), `forgot ${key.id}`) })]));
    box.replaceChildren(rows.length ? make("ul", rows) : make("p", "This browser has no key."));
  };
  const act = async (change, done) => {
    try {
      await change();
      told.replaceChildren(text(done));
    } catch (error) {
      told.replaceChildren(text(error.name === "ConstraintError" ? "this browser has a key of this name already" : error.message));
    }
    file.value = "";
    await refresh();
  };
  const id = make("input", [], { id: "new-key", size: "12" });
  const file = make("input", [], { type: "file", id: "key-file", change: () => file.files[0] &&
    act(async () => signing.keep(await signing.readKeyFile(await file.files[0].text())), "the key is kept; delete the file if nothing else needs it") });
  const adds = make("button", "Make a key", { type: "button", click: () => act(async () => signing.keep(await signing.makeKey(id.value.trim())), "made; the gateway needs its public key in [[commands.keys]]") });
  await refresh();
  return [box, make("p", [make("label", ["Name ", id]), " ", adds]), make("p", make("label", ["or read a key file of `fieldcal keys command` ", file])), told];
}
