// All parts of the page with invented data, so that a change of page.css or parts.js is seen at once.
import { $, make, table } from "./common.js";
import { DAY_NS, plusMinus, signed, two } from "./format.js";
import { bars, card, chip, copier, KINDS, spark, tile } from "./parts.js";
import { boxOf, TimePlots } from "./plots.js";

const N = 60, t = Array.from({ length: N }, (_, k) => Date.UTC(2026, 0, 1) * 1e6 + 5 * k * DAY_NS);
const noise = (k, seed) => 0.03 * Math.sin(12.9898 * (k + 1) * seed);
const drift = t.map((_, k) => Math.max(0, k - 12) * 0.03 + noise(k, 1)), step = t.map((_, k) => (k > 50 ? -3.1 : 0) + noise(k, 2)), calm = t.map((_, k) => noise(k, 3));
const plot = (v, tone, marks) => spark("invented", [{ t, v, u: v.map(() => 0.12), tone }], [t[0], t.at(-1), Math.min(-0.2, ...v) - 0.12, Math.max(0.2, ...v) + 0.12], marks, 46);
const steps = (line) => [make("p", "What a person can do, in a sentence."), copier(line)];

$("chips").append(...Object.keys(KINDS).flatMap((kind) => [chip(kind), " "]));
$("counts").append(...[["sensors", 40, ""], ["in order", 35, "ok"], ["drifting", 1, "bad"], ["held", 2, "warn"], ["not heard", 4, "off"]].map(([title, count, tone], i) => tile(title, count, tone, i === 0, () => undefined)));
$("cards").append(
  card({ kind: "drifting", name: "span-2 / deck-07", where: "", say: ["Sxx rises by ", make("b", "0.20 %"), " (± 0.02 %) a month, ", make("b", "2.4 %"), " (± 0.1 %) since 3 Jan (± 6 d)."], more: "A sound sensor is told so once in 10 years at most. Steady: Syy, Szz, Q.", plot: plot(drift, "x", [t[12]]), steps: steps("fieldcal visit gateway.toml --data-dir visit --sensor deck-07") }),
  card({ kind: "held", name: "span-2 / deck-03", where: "", say: "Held since 24 Nov 14:20: six windows contradict the state.", more: "The calibration before stays in force.", plot: plot(step, "y", [t[50]]), steps: steps("fieldcal command accept --sequence 12 --sensor deck-03 --gateway bridge/span-2 --key KEY --connect ENDPOINT") }),
  card({ kind: "silent", name: "gateway tower-4", where: "", say: "Not heard since 20 Nov (6 d).", more: "Before it fell silent no drift was found.", plot: plot(calm, "z", []), steps: steps("fieldcal doctor /etc/fieldcal/gateway.toml --data-dir /var/lib/fieldcal") }),
);
const box = boxOf("");
$("plot").append(box);
new TimePlots(() => undefined).draw(t.map((ns) => ns / 1e9), [[box, { title: "Invented", unit: " %", digit: 0.01, height: 280, marks: [{ t: t[12] / 1e9, text: "Sxx begins to drift", alarm: true }, { t: t[30] / 1e9, text: "reference ref-B" }], series: [["Sxx", drift, "x"], ["Syy", step, "y"], ["Szz", calm, "z"]].map(([label, values, tone]) => ({ label, values, tone, u: values.map(() => 0.06) })) }]]);
$("bars").append(bars([["reference sensitivity", 0.61], ["reference drift", 0.22], ["type A", 0.16], ["3 others", 0.01]]));
$("numbers").append(table("Numbers", ["Value", "U", "Shown"], [[27192.4321, 26.154], [0.01234567, 0.00099], [-0.00004, 0.01], [1234567.8, 12345], [1.5, null]].map(([v, U]) => [String(v), String(U), `${plusMinus(v, U)}; ${signed(v, U)}; ${two(v)}`])));
