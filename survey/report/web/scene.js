// The survey in space: cameras, targets, points with their ellipsoids; in perspective, as a plan and as elevations.

import { button, colour, fill, make, roundBelow, ruler, surface } from "./dom.js";
import { matrix, eyeOf, sections } from "./ellipsoids.js";
import { obey } from "./hand.js";
import { number, significant, t } from "./words.js";
import { current, names, select } from "./store.js";
import { rowsOfPoint } from "./columns.js";

/** Right and up of the flat views, by axes of the world. */
const FLAT = { plan: [0, 1], south: [0, 2], east: [1, 2] };
export const NAMES = { plan: "Plan", south: "Elevation from the south", east: "Elevation from the east" };
const MOST = 1e5; // points drawn at once

/** Between the signs above and the rulers below: how high (px), and its middle. @param {number} height */
function room(height) {
  const above = Math.min(26, 0.1 * height), free = height - above - Math.min(48, 0.2 * height);
  return { free, cy: above + 0.5 * free };
}

export class SceneView {
  /** @param {any} bench `scene`: shots, spots, outlines, clouds, moves; `shifts` of points @param {string} mode scene, plan, south or east
   *  @param {boolean} [calm] in a page that scrolls: the bare wheel is the page's */
  constructor(bench, mode, calm = false) {
    this.bench = bench;
    this.mode = mode;
    Object.assign(this, { azimuth: -1.08, elevation: 0.47, zoom: 1, dx: 0, dy: 0, hover: null, factor: null });
    this.surface = surface(t("The survey in space"), (context, width, height) => this.paint(context, width, height));
    this.note = make("p", { class: "note floating", "aria-live": "polite" });
    this.told = make("output", { class: "quiet" });
    this.legend = make("p", { class: "legend" });
    this.element = make("div", { class: "view scene" },
      make("div", { class: "bar" }, this.told,
        button("−", () => this.enlarge(0.5), "-", { "aria-label": t("smaller ellipsoids") }), button("+", () => this.enlarge(2), "+", { "aria-label": t("larger ellipsoids") }),
        button("⤢", () => this.whole(), "0", { "aria-label": t("Whole") })),
      make("div", { class: "stage" }, this.surface.canvas, this.legend, this.note));
    const { canvas } = this.surface;
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    obey(canvas, {
      nearer: (by, x, y) => this.nearer(by, x, y), drag: (dx, dy, event) => this.drag(dx, dy, event), arrow: (right, down) => this.arrow(right, down),
      point: (x, y) => this.point(x, y), leave: () => { this.note.textContent = ""; }, click: (event) => this.click(event),
    }, calm);
    this.measure();
  }

  /** Half axes of ellipsoids in sigmas: one, or as many as the page says. */
  get region() { return this.bench.region ?? 1; }

  /** The solution, or what is planned where there is none. */
  get scene() { return this.bench.scene ?? this.bench.planned; }

  /** Middle and size of everything. */
  measure() {
    const { scene } = this;
    if (!scene) { fill(this.legend, t("Known once the survey is adjusted.")); return; }
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    const places = [...this.ends(), ...scene.shots.map((shot) => eyeOf(shot.pose)), ...scene.outlines.flatMap((line) => line.x)];
    for (const x of places) for (let k = 0; k < 3; k++) { low[k] = Math.min(low[k], x[k]); high[k] = Math.max(high[k], x[k]); }
    fill(this.legend, ...this.signs());
    this.low = low;
    this.places = places;
    this.high = high;
    this.middle = low.map((x, k) => (x + high[k]) / 2);
    this.reach = Math.max(1e-3, Math.hypot(...low.map((x, k) => high[k] - x)) / 2);
    const largest = Math.max(1e-12, ...scene.spots.map((spot) => Math.sqrt(Math.max(spot.cov[0][0], spot.cov[1][1], spot.cov[2][2]))));
    if (this.factor !== null) return;
    this.factor = this.first = 10 ** Math.round(Math.log10(0.08 * this.reach / largest));
    this.measure(); // with the ellipsoids
  }

  /** Points and stations, and how far their ellipsoids reach along the axes as they are drawn first. */
  ends() {
    const reach = (spot, k) => this.first * this.region * Math.sqrt(Math.max(0, spot.cov[k][k]));
    return this.scene.spots.flatMap((spot) => [spot.x, ...(this.first ? [-1, 1] : []).flatMap((sign) => [0, 1, 2].map((k) => spot.x.map((x, i) => x + (i === k ? sign * reach(spot, k) : 0))))]);
  }

  /** What is drawn how, of what there is. */
  signs() {
    const { scene } = this, kinds = new Set(scene.spots.map((spot) => spot.kind));
    const found = [["point", "points", kinds.has("point")], ["station", "stations", kinds.has("station")], ["camera", "cameras", scene.shots.length], ["target", "targets", scene.outlines.length || scene.clouds?.length]];
    return found.filter((one) => one[2]).map(([kind, name]) => make("span", {}, make("i", { class: `sign ${kind}` }), t(name)));
  }

  /** Everything in sight again. */
  whole() { Object.assign(this, { zoom: 1, dx: 0, dy: 0, fitted: "" }); this.surface.redraw(); }

  follow() { this.measure(); this.surface.redraw(); }

  /** Turned by hand, or moved: flat views always, the scene with Shift or the right button. */
  drag(dx, dy, event) {
    if (this.mode === "scene" && !event.shiftKey && event.buttons !== 2) this.turn(-dx * 0.008, dy * 0.008);
    else this.pan(dx, dy);
  }

  arrow(right, down) { if (this.mode === "scene") this.turn(0.1 * right, 0.1 * down); else this.pan(30 * right, 30 * down); }

  pan(dx, dy) { this.dx += dx; this.dy += dy; this.surface.redraw(); }

  turn(azimuth, elevation) {
    this.azimuth += azimuth;
    this.elevation = Math.min(1.55, Math.max(-1.55, this.elevation + elevation));
    this.surface.redraw();
  }

  nearer(by, x = this.surface.canvas.clientWidth / 2, y = this.surface.canvas.clientHeight / 2) {
    const zoom = Math.min(400, Math.max(0.1, this.zoom * by)), real = zoom / this.zoom, cx = this.surface.canvas.clientWidth / 2, { cy } = room(this.surface.canvas.clientHeight);
    this.dx = x - cx - (x - cx - this.dx) * real;
    this.dy = y - cy - (y - cy - this.dy) * real;
    this.zoom = zoom;
    this.surface.redraw();
  }

  enlarge(by) { this.factor *= by; this.surface.redraw(); }

  /** The function from the world (m) to the screen (px). */
  projection(width, height) {
    const { middle, reach } = this, { free, cy: half } = room(height), cx = width / 2 + this.dx, cy = half + this.dy;
    if (this.mode !== "scene") {
      const [a, b] = FLAT[this.mode], scale = this.zoom * Math.min((0.88 * width - 24) / Math.max(1e-3, this.high[a] - this.low[a]), (free - 12) / Math.max(1e-3, this.high[b] - this.low[b]));
      this.scale = scale;
      return (x) => [cx + scale * (x[a] - middle[a]), cy - scale * (x[b] - middle[b])];
    }
    const ca = Math.cos(this.azimuth), sa = Math.sin(this.azimuth), ce = Math.cos(this.elevation), se = Math.sin(this.elevation);
    const ray = (x) => {
      const d = [x[0] - middle[0], x[1] - middle[1], x[2] - middle[2]], along = ca * d[0] + sa * d[1];
      const scale = 2.4 * reach / Math.max(2.4 * reach - (ce * along + se * d[2]), 0.3 * reach);
      return [scale * (ca * d[1] - sa * d[0]), scale * (ce * d[2] - se * along)];
    };
    const key = `${width}/${height}/${reach}`;
    if (this.fitted !== key) { // as large as everything is in sight; it stays while the scene is turned
      const [across, up] = this.places.map(ray).reduce((most, x) => [Math.max(most[0], Math.abs(x[0])), Math.max(most[1], Math.abs(x[1]))], [1e-9, 1e-9]);
      [this.fitted, this.unit] = [key, Math.min((0.5 * width - 34) / across, (0.5 * free - 8) / up)];
    }
    const unit = this.unit * this.zoom;
    return (x) => { const [u, v] = ray(x); return [cx + unit * u, cy - unit * v]; };
  }

  paint(context, width, height) {
    const { scene } = this;
    if (!scene || !this.middle || !Number.isFinite(this.reach)) return;
    const to = this.projection(width, height);
    this.to = to;
    const line = (points, closed = false) => {
      context.beginPath();
      points.forEach((x, k) => { const [u, v] = to(x); if (k) context.lineTo(u, v); else context.moveTo(u, v); });
      if (closed) context.closePath();
      context.stroke();
    };
    this.ground(context, line);
    context.lineWidth = 1.1;
    context.strokeStyle = colour("ink");
    for (const outline of scene.outlines) line(outline.x, true);
    this.clouds(context, to);
    for (const { world_from_table: m, axes } of scene.tables ?? []) for (const axis of axes) {
      const k = "xyz".indexOf(axis), end = (far) => [0, 1, 2].map((i) => m[4 * i + 3] + far * m[4 * i + k]);
      context.setLineDash([9, 3, 2, 3]);
      line([end(-0.12 * this.reach), end(0.12 * this.reach)]);
      context.setLineDash([]);
    }
    const chosen = this.chosen();
    for (const shot of scene.shots) this.shot(context, line, to, shot, chosen.image ? shot.image === chosen.image : chosen.cameras.has(shot.camera) && shot.main);
    this.rays(context, line, chosen);
    for (const spot of scene.spots) this.spot(context, line, to, spot, chosen.points.has(spot.id));
    if (this.bench.drawn) this.told_(context, line, to);
    this.labels(context, to);
    this.rulers(context, height);
    const k = significant(this.factor, 2);
    this.told.textContent = this.region === 1 ? t("ellipsoids × {k}", { k }) : t("95 % ellipsoids × {k}", { k });
    this.surface.canvas.setAttribute("aria-label", t("{view}: {c} camera places, {n} points and stations; the same in the tables below", { view: t(NAMES[this.mode] ?? "The survey in space"), c: scene.shots.length, n: scene.spots.length }));
  }

  ground(context, line) {
    const { low, high, mode } = this, [a, b] = FLAT[mode] ?? [0, 1], rest = 3 - a - b;
    const span = Math.max(high[a] - low[a], high[b] - low[b]) / 5, step = roundBelow(span);
    this.step = step;
    context.strokeStyle = colour("rule");
    context.lineWidth = 1;
    for (const [along, across] of [[a, b], [b, a]]) for (let at = Math.ceil(low[along] / step) * step; at <= high[along] && span > 0; at += step) {
      const ends = [low.slice(), low.slice()];
      for (const end of ends) { end[along] = at; end[rest] = low[rest]; }
      ends[1][across] = high[across];
      line(ends);
    }
    const axis = 0.12 * this.reach;
    [["axis-x", [axis, 0, 0]], ["axis-y", [0, axis, 0]], ["axis-z", [0, 0, axis]]].forEach(([name, end]) => { context.strokeStyle = colour(name); context.lineWidth = 2; line([[0, 0, 0], end]); });
  }

  clouds(context, to) {
    context.fillStyle = colour("quiet");
    let left = MOST;
    for (const cloud of this.scene.clouds ?? []) for (const x of cloud.x) { if (left-- <= 0) return; const [u, v] = to(x); context.fillRect(u - 1, v - 1, 2, 2); }
  }

  /** Cameras and points that the selection means. */
  chosen() {
    const { kind, ids } = current(), cameras = new Set(), points = new Set();
    let image = "";
    for (const id of ids) {
      const { what, ids: parts } = names(id);
      if (kind === "camera") cameras.add(parts[0]);
      else if (kind === "image" || (kind === "obs" && what === "image_point")) { image = this.mainOf(parts[0], parts[1]); if (parts.length === 3) points.add(parts[2]); }
      else if (kind === "point" || kind === "station" || kind === "target") points.add(id);
      else if (kind === "param") points.add(parts[1]);
      else if (kind === "reading" || kind === "obs") for (const part of parts) for (const name of part.split("-")) points.add(name);
    }
    return { cameras, points, image };
  }

  /** The image that stands for the place of this one: of equal places only one is drawn. */
  mainOf(camera, epoch) {
    const pose = this.scene.poses[`${camera}/${epoch}`];
    return this.scene.shots.find((shot) => shot.camera === camera && pose && shot.pose.every((x, k) => Math.abs(x - pose[k]) < 1e-4))?.image ?? "";
  }

  /** A camera: its frustum at its first image and where it is chosen, a small mark at every other place. */
  shot(context, line, to, shot, here) {
    context.strokeStyle = context.fillStyle = colour(here ? "point-here" : "blue");
    if (!here && !shot.main) {
      const [u, v] = to(eyeOf(shot.pose));
      context.globalAlpha = 0.55;
      context.fillRect(u - 1.5, v - 1.5, 3, 3);
      context.globalAlpha = 1;
      return;
    }
    const m = shot.pose, [tx, ty] = shot.half.map(Math.tan), d = 0.09 * this.reach;
    const w = (x, y, z) => [0, 1, 2].map((i) => m[4 * i] * x + m[4 * i + 1] * y + m[4 * i + 2] * z + m[4 * i + 3]);
    const eye = w(0, 0, 0), corners = [[-tx, -ty], [tx, -ty], [tx, ty], [-tx, ty]].map(([a, b]) => w(a * d, b * d, d));
    context.lineWidth = here ? 2.2 : 1;
    line(corners, true);
    for (const corner of corners) line([eye, corner]);
    line([w(-0.4 * tx * d, -1.25 * ty * d, d), w(0, -1.5 * ty * d, d), w(0.4 * tx * d, -1.25 * ty * d, d)]); // which way is up in the image
  }

  /** Lines of sight to the points that are chosen, from every image that saw them. */
  rays(context, line, chosen) {
    const { scene } = this, { points } = this.bench;
    context.strokeStyle = colour("point-here");
    context.lineWidth = 1;
    context.setLineDash([5, 4]);
    for (const spot of points ? scene.spots : []) if (spot.kind === "point" && chosen.points.has(spot.id)) {
      for (const i of rowsOfPoint(points, null, spot.id)) {
        const block = points.blocks[points.block[i]], pose = scene.poses[`${block.camera}/${block.epoch}`];
        if (pose) line([eyeOf(pose), spot.x]);
      }
    }
    context.setLineDash([]);
  }

  spot(context, line, to, spot, here) {
    const [u, v] = to(spot.x);
    context.strokeStyle = colour(here ? "point-here" : spot.kind === "point" ? "point-bad" : "point-good");
    context.fillStyle = context.strokeStyle;
    context.lineWidth = here ? 1.8 : 0.9;
    context.globalAlpha = 0.8;
    for (const section of sections(spot.x, spot.cov, this.factor * this.region)) line(section);
    context.globalAlpha = 1;
    context.beginPath();
    if (spot.kind === "point") context.arc(u, v, here ? 5 : 3, 0, 7);
    else context.rect(u - 3.5, v - 3.5, 7, 7); // stations are squares, points are round
    context.fill();
    const shift = this.bench.shifts?.get(spot.id);
    if (shift) { context.lineWidth = 2; context.strokeStyle = colour("warn"); line([spot.x, spot.x.map((x, k) => x + this.factor * shift[k])]); }
  }

  /** What a job has drawn: cameras and lines of a plan, a path with its ellipsoids, motions (enlarged as the ellipsoids are). */
  told_(context, line, to) {
    const { cameras, points, lines, path } = this.bench.drawn;
    context.strokeStyle = colour("soft");
    for (const [image, pose] of Object.entries(cameras)) {
      this.shot(context, line, to, { camera: image.split("/")[0], image, pose, main: true, half: this.scene.cameras[image.split("/")[0]]?.half_angles_rad ?? [0.4, 0.3] }, true);
      const [u, v] = to(eyeOf(pose));
      context.fillText(image, u + 7, v + 12);
    }
    context.strokeStyle = context.fillStyle = colour("soft");
    context.lineWidth = 2.2;
    for (const { x } of lines) line(x);
    for (const { id, x } of points) { const [u, v] = to(x); context.beginPath(); context.arc(u, v, 6, 0, 7); context.stroke(); context.fillText(id, u + 8, v + 12); }
    context.lineWidth = 1.4;
    line(path.map((p) => p.x));
    for (const { x, cov, status } of path) {
      const [u, v] = to(x), known = matrix(cov.map((c) => c ?? 0));
      context.strokeStyle = colour(status === "fixed" ? "soft" : "point-bad");
      for (const section of sections(x, known, this.factor)) line(section);
      context.fillRect(u - 2, v - 2, 4, 4);
    }
  }

  labels(context, to) {
    const { scene } = this, taken = [];
    context.font = "11px system-ui, sans-serif";
    context.lineJoin = "round";
    const first = new Map(scene.shots.filter((shot) => shot.main !== false).map((shot) => [shot.camera, { id: shot.camera, x: eyeOf(shot.pose) }]));
    const boards = scene.outlines.map((o) => ({ id: o.id, x: [0, 1, 2].map((k) => o.x.reduce((sum, x) => sum + x[k], 0) / o.x.length) }));
    for (const { id, x } of [...scene.spots, ...first.values(), ...boards]) {
      const [u, v] = to(x), width = context.measureText(id).width + 6;
      if (taken.some(([a, b, w]) => u < a + w && a < u + width && Math.abs(b - v) < 12)) continue; // none over another
      taken.push([u, v, width]);
      context.lineWidth = 3;
      context.strokeStyle = colour("paper");
      context.strokeText(id, u + 7, v - 5);
      context.fillStyle = colour("ink");
      context.fillText(id, u + 7, v - 5);
    }
  }

  /** Lengths to compare with, of the survey and of its ellipsoids: exact in the flat views, in the middle of the scene. */
  rulers(context, height) {
    const flat = FLAT[this.mode], scale = flat ? this.scale : this.unit * this.zoom, step = flat ? this.step : roundBelow(90 / scale);
    const axes = flat ? `   ${"xyz"[flat[0]]} →  ${"xyz"[flat[1]]} ↑` : "";
    ruler(context, step * scale, height - 18, `${lengthText(step)}${axes}`);
    if (!this.scene.spots.length) return;
    const size = roundBelow(90 / (scale * this.factor));
    ruler(context, size * scale * this.factor, height - 36, t("{length} of ellipsoids and shifts", { length: lengthText(size) }));
  }

  nearest(x, y) {
    if (!this.to) return null;
    const { scene } = this, things = [...scene.spots.map((s) => ({ kind: s.kind === "point" ? "point" : "station", id: s.id, x: s.x, spot: s })),
      ...scene.shots.map((s) => ({ kind: "image", id: s.image, x: eyeOf(s.pose) })), ...scene.outlines.map((o) => ({ kind: "target", id: o.id, x: o.x[0] }))];
    let best = null, least = 12;
    for (const thing of things) { const [u, v] = this.to(thing.x), far = Math.hypot(u - x, v - y); if (far < least) { least = far; best = thing; } }
    return best;
  }

  point(x, y) {
    const found = this.nearest(x, y);
    this.surface.canvas.style.cursor = found ? "pointer" : "grab";
    const sigmas = found?.spot ? `   σ = ${[0, 1, 2].map((k) => number(1000 * Math.sqrt(Math.max(0, found.spot.cov[k][k])), 3)).join(" / ")} mm` : "";
    this.note.textContent = found ? `${t(`kind ${found.kind}`)} ${found.id}   ${found.x.map((c) => number(1000 * c, 2)).join("  ")} mm${sigmas}` : "";
  }

  click(event) { const found = this.nearest(event.offsetX, event.offsetY); if (found) select(found.kind, found.id); }
}

const lengthText = (metres) => { const [size, unit] = metres >= 1 ? [metres, "m"] : metres >= 1e-3 ? [1e3 * metres, "mm"] : [1e6 * metres, "µm"]; return `${significant(size, 1)} ${unit}`; };
