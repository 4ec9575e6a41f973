// What the server says, as values: columns of image points, tables, pictures, live messages.

import { columns, withImages } from "./columns.js";
import { parts } from "./store.js";
import { spoken } from "./words.js";

let token = "";

/** The token stands in the address once; afterwards no link holds it. */
export function takeToken() {
  const kept = parts(location.hash);
  token = kept.find(([name]) => name === "token")?.[1] ?? sessionStorage.getItem("token") ?? "";
  if (token) sessionStorage.setItem("token", token);
  const rest = location.hash.replace(/^#/, "").split("&").filter((part) => part && !part.startsWith("token="));
  history.replaceState(null, "", rest.length ? `#${rest.join("&")}` : location.pathname);
}

/** An answer that is not the one asked for, with the server's own words. */
export class Refused extends Error {
  /** @param {number} status @param {string} text */
  constructor(status, text) { super(text); this.status = status; }
}

async function ask(path, given = {}) {
  const answer = await fetch(path, { ...given, headers: { "X-Token": token, "X-Language": spoken(), ...given.headers } });
  if (answer.ok) return answer;
  const text = await answer.text();
  let said = text;
  try { const body = JSON.parse(text); said = body.error ?? body.message ?? text; } catch { /* not JSON: the text itself */ }
  throw new Refused(answer.status, said || answer.statusText);
}

/** @param {string} path @returns {Promise<any>} */
export const get = async (path) => (await ask(`/api/${path}`)).json();

/** @param {string} path @param {any} [body] @returns {Promise<any>} */
export const post = async (path, body = {}) =>
  (await ask(`/api/${path}`, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) })).json();

/**
 * All image points, with the rows of every image in order; of those that are known only what the solution says of them.
 * @param {any} known the points of before, null for none @returns {Promise<import("./columns.js").Points>}
 */
export async function points(known) {
  const answer = await (await ask(`/api/points${known ? `?layout=${known.layout}` : ""}`)).arrayBuffer(), data = columns(answer);
  for (const { name } of data.columns) data[name] = data[name].slice(); // what stays must not keep what goes
  answer.transfer?.(0); // given back at once
  return data.whole ? withImages(data) : { ...known, ...data, rows: known.rows };
}

const pictures = new Map(); // the last few only: a picture of 5 MP holds 20 MB
const MOST_PICTURES = 12;

/** A picture by its image, sizes 240, 1600 or full. @param {string} image @param {string|number} size @returns {Promise<ImageBitmap>} */
export function picture(image, size) {
  const key = `${image}?${size}`;
  if (!pictures.has(key)) {
    const loading = ask(`/api/image/${image.split("/").map(encodeURIComponent).join("/")}?size=${size}`)
      .then((answer) => answer.blob()).then((blob) => createImageBitmap(blob));
    loading.catch(() => pictures.delete(key));
    pictures.set(key, loading);
    const large = [...pictures.keys()].filter((name) => !name.endsWith("?240"));
    for (const old of large.slice(0, -MOST_PICTURES)) { pictures.get(old).then((bitmap) => bitmap.close(), () => {}); pictures.delete(old); }
  }
  return pictures.get(key);
}

/** The last image of a camera that takes images now, whatever it was before. @param {string} image camera/epoch @param {string|number} size @returns {Promise<ImageBitmap>} */
export const captured = async (image, size) => createImageBitmap(await (await ask(`/api/capture/${encodeURIComponent(image.split("/")[0])}?size=${size}`)).blob());

/** Messages of the server as they come; a connection that broke is taken up again. @param {(message: any) => void} told */
export function live(told, wait = 500) {
  const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`);
  socket.onopen = () => { wait = 500; told({ type: "connected" }); };
  socket.onmessage = (message) => told(JSON.parse(message.data));
  socket.onclose = () => { told({ type: "lost" }); setTimeout(() => live(told, Math.min(2 * wait, 10000)), wait); };
}
