// What the cameras saw last, with the targets found in it and where in their images targets have been so far; the table.

import { button, by, fill, make } from "./dom.js";
import { count, known, number, spoken, t } from "./words.js";
import { changeLanguage, speak, wantedLanguage } from "./speech.js";
import { withImages } from "./columns.js";
import { ImageView } from "./image.js";
import { heat } from "./plots.js";

const EVERY_MS = 700;
const token = location.hash.slice(1); // it stands behind the '#', which browsers never send to anyone
const cameras = new Map();
let last = null;

function tell(text) {
  by("message").textContent = text;
  by("message").hidden = !text;
}

async function command(path, body) {
  const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json", "X-Token": token }, body: JSON.stringify(body) });
  if (!answer.ok) tell((await answer.json()).error);
}

/** Points found in one image as the image's view wants them. @param {string} image camera/epoch @param {number[][]} uv */
function pointsOf(image, uv) {
  const [camera, epoch] = image.split("/"), n = uv.length, none = new Float32Array(n).fill(NaN);
  return withImages({ n, limit: 1, blocks: [{ camera, epoch, target: null }], points: { "": uv.map((_, i) => String(i + 1)) }, block: new Uint32Array(n), point: Uint32Array.from(uv, (_, i) => i),
    u: Float32Array.from(uv, (x) => x[0]), v: Float32Array.from(uv, (x) => x[1]), du: none, dv: none, w: none, used: new Uint8Array(n).fill(1) });
}

async function picture(image, size) {
  const [camera, key] = image.split("/"), answer = await fetch(`/image/${encodeURIComponent(camera)}.png?size=${size}&of=${encodeURIComponent(key)}`);
  if (!answer.ok) throw new Error((await answer.json()).error);
  return createImageBitmap(await answer.blob());
}

function facts(quality, coverage) {
  const list = make("dl", { class: "facts" });
  const row = (name, text, bad = false) => list.append(make("dt", {}, name), make("dd", { class: bad ? "bad" : "" }, text));
  if (quality) {
    row(t("blur"), quality.blur_px === null ? t("no edges") : `${number(quality.blur_px, 2)} px`, quality.blur_px === null);
    row(t("brightness"), `${number(100 * quality.brightness, 0)} %`);
    row(t("saturated"), `${number(100 * quality.saturated, 2)} %`, quality.saturated > 0.001);
    for (const [name, n] of Object.entries(quality.targets)) row(name, n ? t("{n} points", { n: count(n) }) : t("not found"), !n);
  }
  return [list, coverage ? covered(coverage) : null];
}

/** Where in the images targets have been. */
function covered({ cells: [columns, rows], hit, share, size }) {
  const values = new Array(columns * rows).fill(null);
  for (const [i, j] of hit) values[j * columns + i] = 1;
  return heat(t("Coverage"), { size, columns, rows, values, unit: "", said: `${number(100 * share, 0)} % ${t("covered")}` });
}

function showCamera(name, status) {
  const epoch = status.live ? String(status.time) : status.epoch_id;
  if (!cameras.has(name)) {
    const bench = { points: pointsOf(`${name}/`, []), sizes: {}, limit: 1 }, view = new ImageView(bench, picture, true), told = make("div", { class: "told" });
    view.surface.canvas.setAttribute("aria-label", t("last image of camera {id}", { id: name }));
    by("cameras").append(make("section", { class: "camera", "aria-label": name }, view.element, told));
    cameras.set(name, { bench, view, told, epoch: "", said: "" });
  }
  const mine = cameras.get(name), shown = (status.shown ?? {})[name], coverage = (status.coverage ?? {})[name], size = shown?.size ?? [4, 3];
  if (epoch && shown && mine.epoch !== epoch) {
    mine.epoch = epoch;
    mine.bench.points = pointsOf(`${name}/${epoch}`, shown.points);
    mine.bench.sizes[name] = shown.size;
    mine.view.open(`${name}/${epoch}`);
    mine.view.title.textContent = status.live ? name : `${name} · ${epoch}`;
  } else if (!mine.epoch) mine.view.title.textContent = name;
  const said = JSON.stringify([(status.quality ?? {})[name], coverage, spoken()]);
  if (said !== mine.said) { mine.said = said; fill(mine.told, ...facts((status.quality ?? {})[name], coverage && { ...coverage, size })); }
}

function showTable(table, mayMove) {
  by("table").hidden = !table;
  if (!table || document.activeElement?.closest("#table form")) return; // somebody is typing
  const rows = table.axes.map((axis) => {
    const input = make("input", { type: "number", step: "any", value: axis.readback_deg.toFixed(3), min: axis.limits_deg[0], max: axis.limits_deg[1], "aria-label": `${axis.name}: ${t("turn to (deg)")}` });
    const turn = (event) => { event.preventDefault(); document.activeElement?.blur(); command("/jog", { jog: [`${axis.name}=${input.value}`] }); };
    return make("tr", {}, make("td", {}, axis.name), make("td", {}, `${number(axis.readback_deg, 4)} deg`), make("td", {}, t("{a} to {b} deg", { a: axis.limits_deg[0], b: axis.limits_deg[1] })),
      make("td", { class: axis.fault ? "bad" : "" }, axis.fault || t(axis.moving ? "moving" : "at rest")), mayMove ? make("td", {}, make("form", { onsubmit: turn }, input, " ", make("button", {}, t("Turn")))) : null);
  });
  const heads = ["axis", "readback", "limits", "state", ...(mayMove ? ["turn to (deg)"] : [])].map((text) => make("th", { scope: "col" }, t(text)));
  fill(by("table"), make("h2", {}, `${t("Table")} ${table.table}`), make("table", {}, make("thead", {}, make("tr", {}, ...heads)), make("tbody", {}, ...rows)), mayMove ? button(t("Stop"), () => command("/stop", {}), "s", { class: "stop" }) : null);
}

function show(status) {
  const mayMove = status.may_move && token !== "";
  by("state").textContent = known(status.state);
  by("state").className = `state ${status.state.split(" ")[0]}`;
  by("bar").hidden = status.live;
  by("bar").value = status.total ? status.done / status.total : 0;
  by("bar").setAttribute("aria-label", t("{k} of {n} epochs", { k: count(status.done ?? 0), n: count(status.total ?? 0) }));
  const left = status.seconds_left && status.state === "running" ? `, ${t("about {s} s left", { s: count(Math.ceil(status.seconds_left)) })}` : "";
  by("count").textContent = status.live ? "" : by("bar").getAttribute("aria-label") + left;
  tell(status.message || "");
  showTable(status.table, mayMove);
  for (const name of status.cameras) showCamera(name, status);
}

async function refresh() {
  try {
    last = await (await fetch("/status.json")).json();
    show(last);
  } catch {
    by("state").textContent = t("no connection");
    by("state").className = "state broken";
  }
  setTimeout(refresh, EVERY_MS);
}

const views = () => [...cameras.values()].map((one) => one.view);
const KEYS = {
  o: () => views().forEach((view) => { view.overlay = !view.overlay; view.surface.redraw(); }),
  0: () => views().forEach((view) => view.whole()),
  g: () => changeLanguage().then(() => { drawDoing(); if (last) show(last); }),
  s: () => { if (document.querySelector(".stop")) command("/stop", {}); },
};

function drawDoing() { fill(by("doing"), button(t("overlay on or off"), KEYS.o, "o"), button(spoken() === "en" ? "DE" : "EN", KEYS.g, "g", { "aria-label": t("language") })); }

async function begin() {
  await speak(wantedLanguage());
  drawDoing();
  by("state").textContent = t("connecting");
  document.addEventListener("keydown", (event) => { if (!event.target.closest("input") && !event.ctrlKey && !event.metaKey && !event.altKey) KEYS[event.key]?.(); });
  refresh();
}

begin();
