// Commands to one sensor: a dialog shows the command line, and forwards a signed line for users with the right.
import { $, make, text } from "./common.js";
import { copy } from "./parts.js";

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

export function commandLine(order, way) {
  const given = Object.entries(order.arguments).map(([name, value]) => (name === "release" ? "--release" : `--${OPTIONS[name]} ${[value].flat().join(" ")}`));
  return ["fieldcal command", order.verb, ...given, `--sensor ${order.sensor} --gateway ${order.gateway} --key KEY ${way}`].join(" ");
}

// Forwards a line of `fieldcal command ... --print`. The gateway verifies it; what it says is shown with the answer.
async function send(order, line, told) {
  told.replaceChildren(text("sending"));
  try {
    const [site, gateway] = order.gateway.split("/");
    const address = new URLSearchParams({ site, gateway, sensor: order.sensor, verb: order.verb });
    const answer = await fetch(`api/command?${address}`, { method: "POST", headers: { "X-CSRF-Token": me.token }, body: line });
    const said = answer.ok ? await answer.json() : { taken: false, reason: await answer.text() };
    told.replaceChildren(text(said.taken ? `taken by the gateway: ${line.slice(line.indexOf("{"))}` : `refused: ${said.reason}`));
  } catch (error) {
    told.replaceChildren(text(`not sent: ${error.message}`));
  }
}

function pasting(order, told) {
  const pasted = make("textarea", [], { id: "pasted", rows: "5", spellcheck: "false" });
  return [make("p", make("label", ["Then paste the signed line that it prints: ", make("br"), pasted])),
    make("p", make("button", "Send", { type: "button", click: () => send(order, pasted.value, told) }))];
}

// Opens the dialog for an order {gateway, sensor, verb, arguments}.
export function open(order) {
  const may = me.verbs.includes(order.verb), line = commandLine(order, may ? "--valid 300 --print" : "--connect ENDPOINT");
  const told = make("p", [], { role: "status", id: "told" }), code = make("code", line);
  const hint = !me.user ? "Run this line on a machine with your key. Users who log in can also send a signed line from here:"
    : may ? "Run this line on a machine with your key; the signature is valid for 5 minutes:"
      : `${me.user} has no right to send ${order.verb} from here. With a key of your own, run:`;
  $("order").replaceChildren(
    make("h2", `${order.arguments.release ? "release" : order.verb}: ${order.sensor} of ${order.gateway}`, { id: "order-title" }),
    make("p", WHAT[order.arguments.release ? "release" : order.verb]), make("p", hint), make("p", code),
    make("p", make("button", "Copy", { type: "button", click: () => copy(line, code, told) })),
    ...(may ? pasting(order, told) : []), told,
    make("p", make("button", "Close", { type: "button", click: () => $("order").close() })));
  $("order").showModal();
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
