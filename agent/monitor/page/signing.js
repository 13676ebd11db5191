// Signs commands in the browser, with the bytes of agent/commanding/envelope.py. tests/unit/command_vectors.json has
// examples that both must make alike. Private keys are not extractable and stay in this browser's IndexedDB.
const MARK = "fieldcal-command-1";
const NAME = /^[A-Za-z0-9][A-Za-z0-9_.-]{0,62}$/;
const VALID_NS = 60n * 1000000000n;
const ED25519 = { name: "Ed25519" };
const bytes = (string) => new TextEncoder().encode(string);

export const available = () => globalThis.isSecureContext && globalThis.crypto?.subtle !== undefined;

function name(value) {
  if (!NAME.test(value)) throw new RangeError(`${value}: 1 to 63 ASCII letters, digits, '-', '_' and '.'`);
  return `"${value}"`;
}

// A number as msgspec writes it: the shortest digits, with a point, and with an exponent below 1e-5.
function number(value) {
  if (typeof value !== "number" || !(Math.abs(value) < 1e15)) throw new RangeError(`${value} is not a number within limits`);
  if (Object.is(value, -0)) return "-0.0";
  const digits = value !== 0 && Math.abs(value) < 1e-5 ? value.toExponential() : String(value);
  return /^-?[0-9]+$/.test(digits) ? `${digits}.0` : digits;
}

function vector(values) {
  if (values.length !== 3) throw new RangeError("a vector has three numbers");
  return `[${values.map(number).join(",")}]`;
}

function sequence(value) {
  if (!Number.isSafeInteger(value) || value < 1) throw new RangeError(`${value} is not the number of a result`);
  return String(value);
}

const WRITERS = { theta_deg: number, alpha_deg: number, direction: vector, gravity_mps2: vector, position: name, release: String, sequence };

export function body(order) {
  const fields = Object.keys(WRITERS).filter((key) => order.arguments[key] !== undefined);
  const given = fields.map((key) => `"${key}":${WRITERS[key](order.arguments[key])}`).join(",");
  const [site, gateway] = order.gateway.split("/");
  name(site), name(gateway);
  return `{"gateway":"${site}/${gateway}","sensor":${name(order.sensor)},"verb":${name(order.verb)},"arguments":{${given}},` +
    `"counter":${BigInt(order.counter)},"expires_utc_ns":${BigInt(order.expires_utc_ns)}}`;
}

export async function seal(order, keyId, privateKey) {
  name(keyId);
  const content = body(order);
  const signature = await crypto.subtle.sign(ED25519, privateKey, bytes(`${MARK} ${keyId}\n${content}`));
  return bytes(`${MARK} ${keyId} ${base64(signature)}\n${content}`);
}

const base64 = (data) => btoa(String.fromCharCode(...new Uint8Array(data)));
const unbase64 = (string) => Uint8Array.from(atob(string), (c) => c.charCodeAt(0));

// A key file of `fieldcal keys command`: a line with the identifier, then PKCS #8 in PEM.
export async function readKeyFile(content) {
  const id = /^fieldcal command key (.*)$/m.exec(content)?.[1].trim() ?? "";
  const pem = /-----BEGIN PRIVATE KEY-----([A-Za-z0-9+/=\s]*)-----END PRIVATE KEY-----/.exec(content);
  if (!pem || !NAME.test(id)) throw new Error("not a command key, see `fieldcal keys command`");
  const data = unbase64(pem[1].replace(/\s/g, ""));
  const { x } = await crypto.subtle.exportKey("jwk", await crypto.subtle.importKey("pkcs8", data, ED25519, true, ["sign"]));
  const publicKey = `${x.replace(/-/g, "+").replace(/_/g, "/")}=`;
  return { id, publicKey, privateKey: await crypto.subtle.importKey("pkcs8", data, ED25519, false, ["sign"]), counter: "0" };
}

export async function makeKey(id) {
  name(id);
  const pair = await crypto.subtle.generateKey(ED25519, false, ["sign", "verify"]);
  const publicKey = base64(await crypto.subtle.exportKey("raw", pair.publicKey));
  return { id, publicKey, privateKey: pair.privateKey, counter: "0" };
}

function database() {
  return new Promise((resolve, reject) => {
    const opening = indexedDB.open("fieldcal", 1);
    opening.onupgradeneeded = () => opening.result.createObjectStore("keys", { keyPath: "id" });
    opening.onsuccess = () => resolve(opening.result);
    opening.onerror = () => reject(opening.error);
  });
}

async function stored(mode, use) {
  const opened = await database();
  try {
    return await new Promise((resolve, reject) => {
      const transaction = opened.transaction("keys", mode);
      const request = use(transaction.objectStore("keys"));
      transaction.oncomplete = () => resolve(request.result);
      transaction.onerror = transaction.onabort = () => reject(transaction.error);
    });
  } finally {
    opened.close();
  }
}

export const keys = () => stored("readonly", (store) => store.getAll());
export const keep = (key) => stored("readwrite", (store) => store.add(key));
export const forget = (id) => stored("readwrite", (store) => store.delete(id));

// The counter is the time of signing, above the last one of this key; it is kept before the command is sent.
export async function sign(order, id) {
  const key = await stored("readonly", (store) => store.get(id));
  const now = BigInt(Date.now()) * 1000000n, last = BigInt(key.counter);
  const counter = now > last ? now : last + 1n;
  await stored("readwrite", (store) => store.put({ ...key, counter: String(counter) }));
  return seal({ ...order, counter, expires_utc_ns: counter + VALID_NS }, id, key.privateKey);
}
