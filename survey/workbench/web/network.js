// The network of readings: set-ups, points, and a line for every reading, as heavy as it misfits.

import { colour, make } from "./dom.js";
import { count, number, t } from "./words.js";
import { current, select } from "./store.js";
import { get } from "./source.js";
import { NAMES, SceneView } from "./scene.js";

const NEAR = 7; // px on the screen
/** Share of the limit from which a reading is drawn so; the last that applies. */
const CLASSES = [[0, "quiet", 0.8], [0.5, "blue", 1.4], [1, "point-bad", 2.8]];

export class NetworkView extends SceneView {
  /** @param {any} bench */
  constructor(bench) {
    super(bench, "plan");
    this.lines = [];
    this.network = null;
    this.mode_ = make("select", { "aria-label": t("projection"), onchange: () => { this.mode = this.mode_.value; this.surface.redraw(); } },
      ...["plan", "south", "east", "scene"].map((mode) => make("option", { value: mode }, t(NAMES[mode] ?? "Scene"))));
    this.element.querySelector(".bar").prepend(this.mode_);
    this.readings = make("p", { class: "readings quiet" });
    this.element.querySelector(".bar").after(this.readings);
    this.load();
  }

  follow() { super.follow(); this.load(); }

  async load() {
    const version = this.bench.state.version;
    if (this.version === version) return;
    this.version = version;
    if (!this.bench.state.solved) return;
    this.element.setAttribute("aria-busy", "true");
    try { this.network = await get("network"); } catch (error) { this.note.textContent = error.message; }
    this.element.removeAttribute("aria-busy");
    this.surface.redraw();
  }

  paint(context, width, height) {
    super.paint(context, width, height);
    if (!this.network || !this.to) return;
    const { lines, marks, setups, n_nowhere } = this.network, chosen = new Set(current().kind === "reading" ? current().ids : []);
    this.drawn = [];
    for (const reading of [...lines, ...marks]) {
      const ends = reading.x.map((x) => this.to(x)), here = chosen.has(reading.id), style = CLASSES.findLast((c) => (reading.share ?? 0) >= c[0]) ?? CLASSES[0];
      this.drawn.push({ reading, ends });
      context.strokeStyle = colour(here ? "point-here" : reading.why ? "point-out" : style[1]);
      context.lineWidth = here ? 3.2 : style[2];
      context.setLineDash(reading.why ? [4, 4] : []); // what takes no part
      context.beginPath();
      if (ends.length > 1) { context.moveTo(...ends[0]); context.lineTo(...ends[1]); } else context.arc(...ends[0], 8, 0, 7);
      context.stroke();
    }
    context.setLineDash([]);
    context.fillStyle = colour("ink");
    for (const setup of setups) {
      const [u, v] = this.to(setup.x);
      context.beginPath(); // set-ups are triangles
      context.moveTo(u, v - 7); context.lineTo(u + 6, v + 5); context.lineTo(u - 6, v + 5);
      context.fill();
      context.fillText(setup.id, u + 8, v + 14);
    }
    this.readings.textContent = [t("{n} readings, {k} beyond the limit", { n: count(lines.length + marks.length), k: count([...lines, ...marks].filter((r) => (r.share ?? 0) > 1).length) }), n_nowhere ? `, ${t("{m} of no place", { m: count(n_nowhere) })}` : "",
      `. ${t("Lines are readings, circles those of one place: blue from half of the limit, heavy beyond it, dashed what takes no part.")}`].join("");
    this.surface.canvas.setAttribute("aria-label", `${t("Network of readings")}: ${this.readings.textContent}; ${setups.map((s) => `${s.id} (${s.instrument ?? ""}, ${s.n})`).join(", ")}`);
  }

  /** The reading whose line is nearest; points and stations go before lines. */
  line(x, y) {
    let best = null, least = NEAR;
    for (const { reading, ends } of this.drawn ?? []) {
      const [a, b] = [ends[0], ends.at(-1)], dx = b[0] - a[0], dy = b[1] - a[1];
      const along = Math.max(0, Math.min(1, ((x - a[0]) * dx + (y - a[1]) * dy) / Math.max(1e-9, dx * dx + dy * dy)));
      const far = Math.hypot(a[0] + along * dx - x, a[1] + along * dy - y);
      if (far < least) { least = far; best = reading; }
    }
    return best;
  }

  point(x, y) {
    super.point(x, y);
    const reading = this.nearest(x, y) ? null : this.line(x, y);
    if (reading) this.note.textContent = `${reading.id}   w = ${number(reading.w, 2)}`;
  }

  click(event) {
    const reading = this.nearest(event.offsetX, event.offsetY) ? null : this.line(event.offsetX, event.offsetY);
    if (reading) select("reading", reading.id);
    else super.click(event);
  }
}
