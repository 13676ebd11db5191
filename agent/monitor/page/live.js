// The live view of one sensor: the newest block of its corrected stream.
import { $, make, text, view } from "./common.js";
import { AXES, short } from "./format.js";
import { boxOf, curves } from "./plots.js";

let source = null, of = "";

function begin(place) {
  const [site, gateway, sensor] = ["site", "gateway", "sensor"].map((name) => place.get(name));
  $("live-name").replaceChildren(make("a", `${site}/${gateway}/${sensor}`, { href: `#${place}` }));
  $("live-plot").replaceChildren();
  $("live-told").replaceChildren(text("waiting for a block; the gateway sends none unless its channel publishes acceleration"));
  source = new EventSource(`api/live?${place}`);
  source.onmessage = (message) => draw(JSON.parse(message.data));
}

function draw(block) {
  const plot = $("live-plot").firstChild ?? $("live-plot").appendChild(boxOf("Corrected acceleration, newest block"));
  $("live-told").replaceChildren(text(`corrected acceleration by calibration ${block.calibration_sequence || "of the prior"}, ${short(block.rate_hz)} Hz`));
  curves(plot, "a, m/s²", block.acceleration.map((_, k) => k / block.rate_hz), AXES.map((label, i) => ({ label, values: block.acceleration.map((row) => row[i]) })), false);
}

// Shows the sensor of the address, from when it is opened until it is left.
export function show() {
  const now = view(), place = new URLSearchParams(["site", "gateway", "sensor"].map((name) => [name, now.get(name) ?? ""]));
  if (of === place.toString()) return;
  leave();
  of = place.toString();
  begin(place);
}

export function leave() {
  source?.close();
  source = null;
  of = "";
}
