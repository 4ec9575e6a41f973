// The place one looks at is the address of the page: one selection, and every view follows it.

/** @typedef {{kind: string, ids: string[]}} Selection kind: image, obs, point, reading, param, camera, epoch, target, group */

const KINDS = ["image", "obs", "point", "reading", "param", "camera", "epoch", "target", "group", "station", "table"];
const listeners = new Set();
/** Everything in the address: selection, views of the two panes, runs compared. */
const place = { kind: "", ids: /** @type {string[]} */ ([]), view: /** @type {string[]} */ ([]), run: "", against: "" };

/** An id as it stands in an address: "/" and ":" stay readable. @param {string} id */
export const escaped = (id) => encodeURIComponent(id).replaceAll("%2F", "/").replaceAll("%3A", ":").replaceAll("%2C", ",");

/** The address of a thing, as the terminal and the report print it. @param {string} kind @param {string} id */
export const anchor = (kind, id) => `#${kind}=${escaped(id)}`;

/** The parts of an address, decoded. @param {string} hash @returns {[string, string][]} */
export function parts(hash) {
  return hash.replace(/^#/, "").split("&").filter(Boolean).map((part) => {
    const at = part.indexOf("=");
    const [name, value] = at < 0 ? [part, ""] : [part.slice(0, at), part.slice(at + 1)];
    try { return [name, decodeURIComponent(value)]; } catch { return [name, value]; }
  });
}

function read() {
  const next = { kind: "", ids: [], view: place.view, run: "", against: "" };
  for (const [name, value] of parts(location.hash)) {
    if (KINDS.includes(name)) { if (!next.kind) next.kind = name; if (next.kind === name) next.ids.push(value); }
    else if (name === "view") next.view = value.split(",");
    else if (name === "run" || name === "against") next[name] = value;
  }
  Object.assign(place, next);
}

function written() {
  const out = place.ids.slice(0, 50).map((id) => `${place.kind}=${escaped(id)}`);
  if (place.run) out.push(`run=${escaped(place.run)}`);
  if (place.against) out.push(`against=${escaped(place.against)}`);
  if (place.view.length) out.push(`view=${place.view.join(",")}`);
  return `#${out.join("&")}`;
}

export const current = () => place;

/** @param {(what: Set<string>) => void} listener told which parts have changed */
export const subscribe = (listener) => listeners.add(listener);

/**
 * Go somewhere; `quiet` steps (next, previous) leave no entry in the history of the browser.
 * @param {Partial<typeof place>} to
 */
export function go(to, quiet = false) {
  const changed = new Set(Object.keys(to).filter((key) => JSON.stringify(place[key]) !== JSON.stringify(to[key])));
  if (changed.has("kind")) changed.add("ids");
  if (!changed.size) return;
  Object.assign(place, to);
  try { history[quiet ? "replaceState" : "pushState"](null, "", written()); } catch { /* in a mail the address is not ours */ }
  for (const listener of listeners) listener(changed);
}

/** @param {string} kind @param {string|string[]} ids */
export const select = (kind, ids, quiet = false) => go({ kind, ids: Array.isArray(ids) ? ids : [ids] }, quiet);

export function start() {
  read();
  addEventListener("popstate", () => { read(); for (const listener of listeners) listener(new Set(["ids", "view", "run"])); });
}

/** Parts of an id: of an observation `image_point:X/hX05/board/r7c2` its kind and its names. @param {string} id */
export function names(id) {
  const at = id.indexOf(":");
  return { what: at < 0 ? "" : id.slice(0, at), ids: (at < 0 ? id : id.slice(at + 1)).split("/") };
}
