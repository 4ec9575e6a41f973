// One camera, and what hangs together: residuals of the table over its angles, loops, correlations.

import { Asked } from "./asked.js";
import { link, make, plainTable } from "./dom.js";
import { count, estimated, number, significant, t } from "./words.js";
import { anchor, current, names, select } from "./store.js";
import { get } from "./source.js";
import { gridOf, heat, residualField, scatter } from "./plots.js";

/** The camera that the selection means, one of those that there are. @param {string[]} cameras @returns {string|undefined} */
function chosenCamera(cameras) {
  const { kind, ids } = current();
  const said = kind === "camera" ? ids[0] : kind === "image" ? ids[0].split("/")[0] : kind === "obs" ? names(ids[0]).ids[0] : kind === "param" && ids[0].startsWith("lens/") ? ids[0].split("/")[1] : "";
  return cameras.includes(said) ? said : undefined;
}

const metresField = (value, change) => make("input", { type: "number", min: "0.01", step: "any", value: value ?? "", placeholder: "∞", "aria-label": t("distance, m"), onchange: (event) => change(event.target.value) });

export class CameraView extends Asked {
  question() { return `${this.camera()}/${JSON.stringify(this.against)}/${this.distance ?? ""}`; }

  camera() {
    const cameras = Object.keys(this.bench.sizes);
    this.last = chosenCamera(cameras) ?? this.last ?? cameras[0];
    return this.last;
  }

  async parts() {
    const camera = this.camera(), size = this.bench.sizes[camera], { field, coverage } = residualField(this.bench.points, camera, size);
    const plots = make("div", { class: "figures" }, heat(t("Residual field: mean vectors over the root mean square"), field), heat(t("Coverage: image points"), coverage));
    const choose = make("select", { "aria-label": t("Camera"), onchange: (event) => select("camera", event.target.value) }, ...Object.keys(this.bench.sizes).map((id) => make("option", { value: id, selected: id === camera }, id)));
    const distance = metresField(this.distance, (value) => { this.distance = value; this.follow(); });
    const runs = (await get("runs")).runs, choices = [...runs.map((run) => [{ run: run.number }, `${t("run")} ${run.number}`]), ...Object.keys(this.bench.sizes).filter((id) => id !== camera && this.bench.sizes[id].join() === size.join()).map((id) => [{ other: id }, `${t("camera")} ${id}`])];
    const others = make("select", { "aria-label": t("difference to"), onchange: () => { this.against = choices[others.selectedIndex - 1]?.[0]; this.follow(); } },
      make("option", {}, "–"), ...choices.map(([what, text]) => make("option", { selected: JSON.stringify(what) === JSON.stringify(this.against) }, text)));
    this.said = make("p", { class: "warn" });
    this.plots = plots;
    return [make("div", { class: "bar" }, choose, make("label", {}, t("distance, m"), " ", distance), make("label", {}, t("difference to"), " ", others)), plots, this.said];
  }

  async more() {
    if (!this.bench.state.solved) return;
    const { plots, said } = this, camera = this.camera(), size = this.bench.sizes[camera], path = `camera/${encodeURIComponent(camera)}`;
    const asked = this.distance ? `distance_m=${encodeURIComponent(this.distance)}` : "";
    try {
      const { distortion: d, uncertainty: s } = await get(`${path}?${asked}`), body = s.station ?? s.camera;
      const away = d.uv.map((uv, k) => [uv[0] - d.without[k][0], uv[1] - d.without[k][1]]), covered = (values) => gridOf(size, s.uv, values.map((x, k) => (s.covered[k] ? x : null)));
      plots.append(heat(t("Distortion: what the lens moves"), gridOf(size, d.uv, away.map((x) => Math.hypot(...x)), away)),
        heat(s.station ? t("Uncertainty of projection (one sigma), camera on its station") : t("Uncertainty of projection (one sigma), camera by itself"), covered(body)));
      if (s.station) plots.append(heat(t("Uncertainty of projection (one sigma), camera by itself"), covered(s.camera)));
      if (!this.against) return;
      const found = await get(`${path}/difference?${new URLSearchParams(this.against)}&${asked}`);
      plots.append(heat(`${t("Difference of two lens results, implied rotation fitted")}: ${significant(found.rotation_deg, 2)}°, ${significant(found.translation_mm, 2)} mm`, gridOf(size, found.uv, found.shift.map((x) => Math.hypot(...x)), found.shift)));
    } catch (error) { said.textContent = error.message; }
  }
}

/** The epochs in two halves, each adjusted by itself: lenses that differ by more than expected contradict their sigmas. */
export class HalvesView extends Asked {
  get needs() { return true; }

  question() { return this.distance ?? ""; }

  async follow() { await super.follow(); this.plot(); }

  async parts() {
    const { key } = this, found = await get(`halves?${this.distance ? `distance_m=${encodeURIComponent(this.distance)}` : ""}`), { cameras, epochs, sigma0, notes } = found;
    if (this.key !== key) return [];
    this.found = found;
    this.plots = make("div", { class: "figures" });
    this.plotted = "";
    const rows = cameras.map((c) => [link(anchor("camera", c.camera), c.camera), number(c.rms_px, 4), number(c.expected_px, 4), number(c.ratio, 2), make("span", { class: c.p_value < 0.01 ? "bad" : "" }, `${c.p_value < 0.01 ? "■ " : ""}${significant(c.p_value, 2)}`), `${c.largest} ${number(c.largest_in_sigmas, 1)} σ`]);
    return [make("div", { class: "bar" }, make("label", {}, t("distance, m"), " ", metresField(this.distance, (value) => { this.distance = value; this.follow(); }))),
      make("p", { class: "quiet" }, t("Halves of {a} and {b} epochs, each adjusted by itself: sigma0 {s} and {u}. The difference of the lenses, with the motion of the camera taken out, beside what their covariances expect.", { a: epochs[0].length, b: epochs[1].length, s: number(sigma0[0], 4), u: number(sigma0[1], 4) })),
      plainTable(t("Cross-validation"), [t("camera"), t("differ, px"), t("expected, px"), t("ratio"), "p", t("largest change")], rows, [1, 2, 3, 4]), this.plots, ...notes.map((note) => make("p", { class: "quiet" }, note))];
  }

  /** Difference and expectation of the chosen camera, in the same colours. */
  plot() {
    const cameras = this.found?.cameras ?? [], id = chosenCamera(cameras.map((c) => c.camera)) ?? (this.plotted || cameras[0]?.camera), c = cameras.find((one) => one.camera === id);
    if (!c || id === this.plotted) return;
    this.plotted = id;
    const size = this.bench.sizes[id], far = c.shift.map((x) => Math.hypot(...x)), sigma = c.sigma.map((x, k) => (c.covered[k] ? x : null)), high = Math.max(...far.filter((_, k) => c.covered[k]), ...sigma);
    this.plots.replaceChildren(heat(`${id} (${t("{n} images", { n: c.n_images.join(" + ") })}): ${t("difference of the halves, implied motion taken out")}: ${significant(c.rotation_deg, 2)}°, ${significant(c.translation_mm, 2)} mm`, { ...gridOf(size, c.uv, far.map((x, k) => (c.covered[k] ? x : null)), c.shift.map((x, k) => (c.covered[k] ? x : [NaN, NaN]))), high }),
      heat(`${id}: ${t("expected difference, one sigma")}`, { ...gridOf(size, c.uv, sigma), high }));
  }
}

/** Standardized residuals of a turntable's readings over its angle, the axes as series. */
export class TableAnglesView extends Asked {
  async parts() {
    const rows = this.bench.readings.filter((row) => row.table === "table_angles" && row.w !== null && row.w !== undefined);
    if (!rows.length) return [make("p", { class: "quiet" }, t("No turntable in this survey."))];
    const tables = Map.groupBy(rows, (row) => row.name.split("/")[0]);
    return [...tables].flatMap(([table, mine]) => [...Map.groupBy(mine, (row) => row.component)].map(([axis, readings]) => scatter(`${table} ${axis}`,
      [{ name: t("in use"), of: readings.filter((r) => r.used) }, { name: t("left out"), of: readings.filter((r) => !r.used) }].filter((s) => s.of.length)
        .map((s) => ({ name: s.name, x: s.of.map((r) => r.observed), y: s.of.map((r) => r.w), anchors: s.of.map((r) => ["reading", r.id]) })),
      { x: `${axis} [${readings[0].unit}]`, y: "w", band: this.bench.limit, onpick: select })));
  }
}

export class LoopsView extends Asked {
  get needs() { return true; }

  async parts() {
    const found = (await get("loops")).loops, loops = found?.worst_first ?? [];
    if (!loops.length) return [make("p", { class: "quiet" }, t("No loops: the survey measures no pairs."))];
    const closing = (loop, unit) => (loop[`misclosure_${unit}`] === undefined ? "–" : `${estimated({ value: loop[`misclosure_${unit}`], sigma: loop[`sigma_misclosure_${unit}`] })} ± ${significant(loop[`sigma_misclosure_${unit}`], 2)}`);
    const rows = loops.map((loop) => [make("div", { class: "wide" }, make("span", { class: loop.closes ? "" : "bad" }, `${loop.closes ? "" : "■ "}${loop.stations.join(" → ")}`), make("div", {}, ...loop.pairs.flatMap((pair) => [link(anchor("reading", `pairs:${pair}`), pair, { class: "whole" }), " "]))), closing(loop, "arcsec"), closing(loop, "mm"), significant(loop.test, 3), significant(loop.p_value, 2)]);
    return [make("h2", {}, t("Loops"), " ", make("span", { class: "quiet" }, count(found.n_loops))), ...(loops.length < found.n_loops ? [make("p", { class: "quiet" }, t("{n} more in solution.json.", { n: count(found.n_loops - loops.length) }))] : []), plainTable(t("Loops"), [`${t("loop")}, ${t("Pairs")}`, t("misclosure, arcsec"), t("misclosure, mm"), t("Test"), "p"], rows, [1, 2, 3, 4])];
  }
}

export class CorrelationsView extends Asked {
  get needs() { return true; }

  async parts() {
    const [correlated, weak] = await Promise.all(["correlations", "weak"].map(async (part) => (await get(`statistics/${part}`))[part] ?? []));
    const name = (id) => link(anchor("param", id), id);
    return [make("h2", {}, t("Correlations"), " ", make("span", { class: "quiet" }, count(correlated.length))), make("p", { class: "quiet" }, t("Parameters correlated by more than 95 %, the most first.")),
      plainTable(t("Correlations"), [t("correlation"), t("parameter"), t("parameter")], correlated.slice(0, 300).map((c) => [number(c.correlation, 4), name(c.a), name(c.b)]), [0]),
      make("h2", {}, t("Weak directions")), make("p", { class: "quiet" }, t("So many times weaker together than each alone, and what moves how far.")),
      ...weak.slice(0, 8).map((w) => make("p", {}, make("b", {}, `× ${significant(w.inflation, 3)}`), "  ", Object.entries(w.parts).slice(0, 6).map(([id, share]) => `${id} ${number(share, 3)}`).join("   ")))];
  }
}
