// What all views use. Every text of the bus passes `text`, which makes text nodes alone: no string is read as HTML.
export const $ = (id) => document.getElementById(id);
// Control characters, and those that turn the direction of writing, are shown as such.
const UNSEEN = /[\u0000-\u001f\u007f-\u009f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]/g;
export const clean = (value) => (value === null || value === undefined ? "" : String(value).replace(UNSEEN, "\ufffd"));
export const text = (value) => document.createTextNode(clean(value));

export function make(tag, children = [], attributes = {}) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") element.addEventListener(name, value);
    else if (value !== false && value !== null) element.setAttribute(name, value === true ? "" : value);
  }
  for (const child of [children].flat()) element.append(child instanceof Node ? child : text(child));
  return element;
}

// The view is in the address behind #, so that a link keeps it.
export const view = () => new URLSearchParams(location.hash.slice(1));
export const full = (row) => `${row.site}/${row.gateway}/${row.sensor}`;
export const placeOf = (row) => new URLSearchParams({ site: row.site, gateway: row.gateway, sensor: row.sensor });

// Nothing comes from it.
export const isUnheard = (row) => row.kind === "silent" || row.kind === "retired";

export class NeedsLogin extends Error {}

const ANSWERS_MS = 60000; // a monitor that hangs must not leave old values unmarked

export async function get(path) {
  const answer = await fetch(path, { signal: AbortSignal.timeout(ANSWERS_MS) });
  if (answer.status === 401) throw new NeedsLogin();
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

// A table with a caption for screen readers; cells are texts or elements.
export function table(caption, heads, rows) {
  const body = rows.map((row) => make("tr", row.map((cell) => make("td", cell === null ? "" : cell))));
  const head = make("thead", make("tr", heads.map((title) => make("th", title, { scope: "col" }))));
  return make("div", make("table", [make("caption", caption, { class: "hidden" }), head, make("tbody", body)]), { class: "wide", tabindex: "0", role: "region", "aria-label": caption });
}
