// What the cameras saw last, with the targets found in it and where in their images targets have been so far.

import { fill, make } from "./dom.js";
import { count, known, number, spoken, t } from "./words.js";
import { withImages } from "./columns.js";
import { ImageView } from "./image.js";
import { heat } from "./plots.js";

/** Colour and words of how far a session is. @param {any} status */
export function progress(status) {
  const left = status.seconds_left && status.state === "running" ? `, ${t("about {s} s left", { s: count(Math.ceil(status.seconds_left)) })}` : "";
  return { state: known(status.state), kind: `state ${status.state.split(" ")[0]}`, share: status.total ? status.done / status.total : 0, epochs: t("{k} of {n} epochs", { k: count(status.done ?? 0), n: count(status.total ?? 0) }), left };
}

/** Points found in one image as the image's view wants them. @param {string} image camera/epoch @param {number[][]} uv */
function pointsOf(image, uv) {
  const [camera, epoch] = image.split("/"), n = uv.length, none = new Float32Array(n).fill(NaN);
  return withImages({ n, limit: 1, blocks: [{ camera, epoch, target: null }], points: { "": uv.map((_, i) => String(i + 1)) }, block: new Uint32Array(n), point: Uint32Array.from(uv, (_, i) => i),
    u: Float32Array.from(uv, (x) => x[0]), v: Float32Array.from(uv, (x) => x[1]), du: none, dv: none, w: none, used: new Uint8Array(n).fill(1) });
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

export class Cameras {
  /** @param {(image: string, size: string|number) => Promise<ImageBitmap>} picture of camera/epoch */
  constructor(picture) {
    Object.assign(this, { picture, cameras: new Map(), element: make("div", { class: "cameras" }) });
  }

  /** @param {any} status what the server says of a session */
  show(status) { for (const name of status.cameras) this.camera(name, status); }

  get views() { return [...this.cameras.values()].map((one) => one.view); }

  camera(name, status) {
    const epoch = status.live ? String(status.time) : status.epoch_id;
    if (!this.cameras.has(name)) {
      const bench = { points: pointsOf(`${name}/`, []), sizes: {}, limit: 1 }, view = new ImageView(bench, this.picture, true), told = make("div", { class: "told" });
      view.surface.canvas.setAttribute("aria-label", t("last image of camera {id}", { id: name }));
      this.element.append(make("section", { class: "camera", "aria-label": name }, view.element, told));
      this.cameras.set(name, { bench, view, told, epoch: "", said: "" });
    }
    const mine = this.cameras.get(name), shown = (status.shown ?? {})[name], coverage = (status.coverage ?? {})[name], size = shown?.size ?? [4, 3];
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
}
