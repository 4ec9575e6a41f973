// One image: the picture, detected (o) and predicted (+) points, residual vectors enlarged, what is left out dashed.

import { button, colour, make, roundBelow, ruler, surface } from "./dom.js";
import { obey } from "./hand.js";
import { count, number, significant, t } from "./words.js";
import { current, names, select } from "./store.js";
import { pointId, rowOf, rowsOfImage, rowsOfPoint, rowsWhere } from "./columns.js";

const NEAR = 14; // px on the screen: what a click takes hold of
const FILM = 60; // pictures in the strip, about the one that is shown: each is a canvas
const SCALES = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000];

export class ImageView {
  /**
   * @param {any} bench the page's values: `points`, `sizes` of images by camera, `limit` of w
   * @param {((image: string, size: string|number) => Promise<ImageBitmap>)|null} picture of an image; null: there are none
   * @param {boolean} [steady] one camera whose pictures come by themselves: its place stays, nothing is chosen
   */
  constructor(bench, picture, steady = false) {
    this.bench = bench;
    this.fetch = picture;
    this.steady = steady;
    this.image = "";
    this.enlarged = 200;
    this.overlay = true;
    this.fit = true;
    this.hover = -1;
    this.surface = surface(t("Image"), (context, width, height) => this.paint(context, width, height));
    const canvas = this.surface.canvas;
    this.title = make("b", { class: "ellipsis" });
    this.scale = make("output", { class: "quiet" });
    this.note = make("p", { class: "note floating", "aria-live": "polite" });
    this.strip = make("div", { class: "filmstrip", role: "listbox", "aria-label": t("Images of this camera") });
    this.element = make("div", { class: "view image" },
      make("div", { class: "bar" }, this.title, this.scale,
        steady ? null : [button("−", () => this.enlarge(-1), "-", { "aria-label": t("shorter vectors") }), button("+", () => this.enlarge(1), "+", { "aria-label": t("longer vectors") })],
        button("⤢", () => this.whole(), "0", { "aria-label": t("Whole") }), button("1:1", () => this.zoomTo(1 / (devicePixelRatio || 1)), "", { "aria-label": "1:1" })),
      make("div", { class: "stage" }, canvas, this.note), steady ? null : this.strip);
    obey(canvas, {
      nearer: (by, x, y) => this.zoom(by, x, y), drag: (dx, dy) => this.pan(dx, dy), arrow: (right, down) => this.pan(40 * right, 40 * down),
      point: (x, y) => this.point(x, y), leave: () => { this.hover = -1; if (this.bitmap) this.note.textContent = ""; }, click: (event) => this.click(event),
    });
    this.follow();
  }

  /** What fetches a picture, where there are any. */
  get picture() { return this.bench.pictured === false ? null : this.fetch; }

  /** What is looked at follows the selection. */
  follow() {
    const { kind, ids } = current(), data = this.bench.points;
    if (!data) return;
    let image = this.image;
    this.row = -1;
    if (kind === "image" && ids[0]) image = ids[0];
    else if (kind === "obs" && names(ids[0]).what === "image_point") {
      const parts = names(ids[0]).ids;
      image = `${parts[0]}/${parts[1]}`;
      this.row = rowOf(data, parts);
    } else if (kind === "camera") image = data.images.find((name) => name.startsWith(`${ids[0]}/`)) ?? image;
    else if (kind === "epoch") image = data.images.find((name) => name.endsWith(`/${ids[0]}`)) ?? image;
    else if (kind === "point" || kind === "target") {
      const at = this.worstOf(kind === "point" ? rowsOfPoint(data, null, ids[0]) : rowsWhere(data, (b) => b.target === ids[0]));
      if (at >= 0) { const block = data.blocks[data.block[at]]; image = `${block.camera}/${block.epoch}`; if (kind === "point") this.row = at; }
    }
    if (!image && this.all.length) {
      const at = this.worstOf(null), block = data.blocks[data.block[at]];
      image = block ? `${block.camera}/${block.epoch}` : this.all[0];
    }
    if (image !== this.image) this.open(image);
    else if (this.row >= 0) this.keepInSight();
    this.surface.redraw();
  }

  /** All images: those with points, or those of the project in which nothing was found yet. */
  get all() { const { images } = this.bench.points; return images.length ? images : this.bench.images ?? []; }

  /** @param {ArrayLike<number>|null} rows null: all */
  worstOf(rows) {
    const { w } = this.bench.points, n = rows?.length ?? w.length, row = (k) => (rows ? rows[k] : k);
    let at = n ? row(0) : -1;
    for (let k = 0; k < n; k++) if (w[row(k)] > w[at] || !(w[at] >= 0)) at = row(k);
    return at;
  }

  async open(image) {
    this.image = image;
    if (!this.steady) { this.bitmap = null; this.fit = true; }
    this.size = this.bench.sizes[image.split("/")[0]];
    this.title.textContent = image.replace("/", " · ");
    this.film();
    this.note.textContent = "";
    const started = performance.now();
    try {
      const bitmap = await this.picture?.(image, 1600);
      if (this.image !== image) return;
      this.bitmap = bitmap ?? null;
      this.size ??= bitmap && [bitmap.width, bitmap.height];
      this.note.textContent = "";
    } catch (error) {
      if (this.image === image) this.note.textContent = t("No picture: {why}", { why: error.message });
    }
    this.surface.redraw();
    document.body.dataset.picture = String(Math.round(performance.now() - started));
  }

  /** Pictures of the same camera, or those of the same moment; only what is in sight is fetched. */
  film() {
    const [camera, epoch] = this.image.split("/");
    if (this.steady) return;
    const all = this.all.filter((name) => name.startsWith(`${camera}/`)), at = all.indexOf(this.image);
    const k = this.filmed?.indexOf(this.image) ?? -1, cut = (k < 6 && this.filmed?.[0] !== all[0]) || (k > FILM - 6 && this.filmed?.at(-1) !== all.at(-1));
    if (k < 0 || cut || this.filmedOf !== all.length) {
      const from = Math.max(0, Math.min(at - FILM / 2, all.length - FILM)), near = all.slice(from, from + FILM);
      [this.filmed, this.filmedOf] = [near, all.length];
      this.seen?.disconnect();
      this.seen = new IntersectionObserver((entries) => { for (const entry of entries) if (entry.isIntersecting) this.thumbnail(entry.target); }, { root: this.strip, rootMargin: "200px" });
      this.strip.replaceChildren(...near.map((name) => {
        const place = make("button", { type: "button", role: "option", class: "frame", data: { image: name }, tabindex: -1, onclick: () => select("image", name) },
          make("canvas", { width: 96, height: 72, "aria-hidden": "true" }), make("span", {}, name.split("/")[1]));
        this.seen.observe(place);
        return place;
      }));
    }
    for (const place of this.strip.children) {
      const here = place.dataset.image === `${camera}/${epoch}`;
      place.setAttribute("aria-selected", String(here));
      if (here) requestAnimationFrame(() => { this.strip.scrollLeft = place.offsetLeft - this.strip.clientWidth / 2 + 48; });
    }
  }

  async thumbnail(place) {
    this.seen.unobserve(place);
    const { image } = place.dataset, context = place.querySelector("canvas").getContext("2d"), fit = (width, height) => { const scale = Math.min(96 / width, 72 / height); return [scale, (96 - scale * width) / 2, (72 - scale * height) / 2]; };
    try {
      const bitmap = await this.picture(image, 240), [scale, x, y] = fit(bitmap.width, bitmap.height);
      context.drawImage(bitmap, x, y, scale * bitmap.width, scale * bitmap.height);
    } catch { // of an image without a file its points are known
      const data = this.bench.points, [scale, x, y] = fit(...this.size ?? [1280, 1024]);
      context.fillStyle = colour("point-good");
      for (const i of rowsOfImage(data, image)) context.fillRect(x + scale * data.u[i] - 1, y + scale * data.v[i] - 1, 2, 2);
    }
  }

  /** The image before or after in the strip (`[`, `]`), or of the next epoch. @param {number} by */
  next(by, sameEpoch = false) {
    const { all } = this, [camera, epoch] = this.image.split("/");
    const among = all.filter((name) => (sameEpoch ? name.endsWith(`/${epoch}`) : name.startsWith(`${camera}/`)));
    const to = among[(among.indexOf(this.image) + by + among.length) % among.length];
    if (to) select("image", to, true);
  }

  /** All of the image in sight again. */
  whole() { this.fit = true; this.surface.redraw(); }

  /** Marks and vectors on or off. */
  toggle() { this.overlay = !this.overlay; this.surface.redraw(); }

  enlarge(by) {
    const at = SCALES.findIndex((scale) => scale >= this.enlarged);
    this.enlarged = SCALES[Math.max(0, Math.min(SCALES.length - 1, at + by))];
    this.surface.redraw();
  }

  zoom(factor, x, y) {
    const scale = Math.max(0.02, Math.min(64, this.s * factor)), by = scale / this.s;
    this.fit = false;
    this.ox = x - (x - this.ox) * by;
    this.oy = y - (y - this.oy) * by;
    this.s = scale;
    this.surface.redraw();
  }

  zoomTo(scale) {
    const canvas = this.surface.canvas;
    let x = canvas.clientWidth / 2, y = canvas.clientHeight / 2;
    if (this.row >= 0) { const data = this.bench.points; x = this.ox + (data.u[this.row] + 0.5) * this.s; y = this.oy + (data.v[this.row] + 0.5) * this.s; }
    this.zoom(scale / this.s, x, y);
    this.keepInSight();
  }

  pan(dx, dy) { this.fit = false; this.ox += dx; this.oy += dy; this.surface.redraw(); }

  keepInSight() {
    const data = this.bench.points, canvas = this.surface.canvas, x = this.ox + (data.u[this.row] + 0.5) * this.s, y = this.oy + (data.v[this.row] + 0.5) * this.s;
    if (x < 20 || y < 20 || x > canvas.clientWidth - 20 || y > canvas.clientHeight - 20) this.pan(canvas.clientWidth / 2 - x, canvas.clientHeight / 2 - y);
  }

  nearest(x, y) {
    const data = this.bench.points;
    let best = -1, least = NEAR;
    for (const i of rowsOfImage(data, this.image)) {
      const far = Math.hypot(this.ox + (data.u[i] + 0.5) * this.s - x, this.oy + (data.v[i] + 0.5) * this.s - y);
      if (far < least) { least = far; best = i; }
    }
    return best;
  }

  point(x, y) {
    const at = this.nearest(x, y), data = this.bench.points;
    if (at === this.hover) return;
    this.hover = at;
    this.surface.canvas.style.cursor = at < 0 ? "grab" : "pointer";
    this.note.textContent = at < 0 ? "" : `${pointId(data, at)}   v = (${number(data.du[at], 3)}, ${number(data.dv[at], 3)}) px   w = ${number(data.w[at], 2)}`;
  }

  click(event) {
    const at = this.nearest(event.offsetX, event.offsetY);
    if (at < 0 || this.steady) return;
    const id = `image_point:${pointId(this.bench.points, at)}`, { kind, ids } = current();
    if (event.shiftKey && kind === "obs") select("obs", ids.includes(id) ? ids.filter((x) => x !== id) : [...ids, id]);
    else select("obs", id);
  }

  paint(context, width, height) {
    if (!this.image) return;
    const size = this.size ?? [1280, 1024], data = this.bench.points;
    if (this.fit) {
      this.s = Math.min(width / size[0], height / size[1]);
      this.ox = (width - this.s * size[0]) / 2;
      this.oy = (height - this.s * size[1]) / 2;
    }
    if (this.bitmap) {
      if (this.s * (devicePixelRatio || 1) > 1.2 * this.bitmap.width / size[0] && this.bitmap.width < size[0]) this.sharper();
      context.imageSmoothingEnabled = this.s * size[0] < 4 * this.bitmap.width;
      context.drawImage(this.bitmap, this.ox, this.oy, this.s * size[0], this.s * size[1]);
    } else { context.fillStyle = colour("sunk"); context.fillRect(this.ox, this.oy, this.s * size[0], this.s * size[1]); }
    const rows = rowsOfImage(data, this.image);
    this.scale.textContent = !this.overlay ? t("overlay off (o)") : this.steady ? t("{n} points", { n: count(rows.length) }) : `v × ${count(this.enlarged)}`;
    this.scale.title = this.steady ? "" : t("residual vectors enlarged");
    if (this.overlay) this.marks(context, rows);
    if (this.overlay && rows.length && !this.steady) { const step = roundBelow(110 / this.stretch); ruler(context, step * this.stretch, height - 12, t("{size} px of residuals", { size: significant(step, 1) })); }
    const out = rows.reduce((sum, i) => sum + (data.used[i] ? 0 : 1), 0);
    this.surface.canvas.setAttribute("aria-label", t("Image {image}: {n} points, {out} left out, residual vectors enlarged {k} times", { image: this.image, n: rows.length, out, k: this.enlarged }));
  }

  /** Pixels of the screen for each pixel of a residual: less than the enlarged picture's where it is seen pixel by pixel. */
  get stretch() { return this.enlarged * this.s / Math.max(1, this.s / 4); }

  sharper() {
    const image = this.image;
    if (this.asked === image || !this.picture) return;
    this.asked = image;
    this.picture(image, "full").then((bitmap) => { if (this.image === image) { this.bitmap = bitmap; this.surface.redraw(); } }, () => {}).finally(() => { this.asked = ""; });
  }

  marks(context, rows) {
    const data = this.bench.points, chosen = new Set(current().kind === "obs" ? current().ids : []);
    const colours = { good: colour("point-good"), bad: colour("point-bad"), out: colour("point-out"), here: colour("point-here") };
    const size = Math.max(3, Math.min(7, 3 + this.s));
    for (const wide of [true, false]) for (const i of rows) {
      const x = this.ox + (data.u[i] + 0.5) * this.s, y = this.oy + (data.v[i] + 0.5) * this.s;
      const suspect = data.used[i] && Math.abs(data.w[i]) > data.limit, here = i === this.row || chosen.has(`image_point:${pointId(data, i)}`);
      context.strokeStyle = wide ? "rgba(0,0,0,0.55)" : here ? colours.here : suspect ? colours.bad : data.used[i] ? colours.good : colours.out;
      context.lineWidth = (here ? 2.4 : 1.4) + (wide ? 1.6 : 0);
      context.setLineDash(data.used[i] ? [] : [3, 2.5]);
      context.beginPath();
      if (suspect) context.rect(x - size - 1, y - size - 1, 2 * size + 2, 2 * size + 2); // a square: told apart without colour
      else { context.moveTo(x + size, y); context.arc(x, y, size, 0, 7); }
      if (here) { context.moveTo(x + size + 6, y); context.arc(x, y, size + 6, 0, 7); }
      const px = x + data.du[i] * this.s, py = y + data.dv[i] * this.s;
      if (this.s > 3) { context.moveTo(px - 4, py); context.lineTo(px + 4, py); context.moveTo(px, py - 4); context.lineTo(px, py + 4); }
      const length = Number.isFinite(data.du[i]) ? this.stretch : 0;
      if (length) { context.moveTo(x, y); context.lineTo(x + length * data.du[i], y + length * data.dv[i]); }
      context.stroke();
      if (!wide && here && data.sigma_u) this.ellipse(context, i, x, y, length);
    }
    context.setLineDash([]);
  }

  /** The sigma of the detected place, as large as the vectors are. */
  ellipse(context, i, x, y, length) {
    const data = this.bench.points;
    context.setLineDash([]);
    context.lineWidth = 1.2;
    context.beginPath();
    context.ellipse(x, y, Math.abs(length * data.sigma_u[i]), Math.abs(length * data.sigma_v[i]), 0, 0, 7);
    context.stroke();
  }
}

