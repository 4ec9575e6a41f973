// One camera, and what hangs together: residuals of the table over its angles, loops, correlations.

import { link, make, plainTable } from "./dom.js";
import { count, known, number, significant, t } from "./words.js";
import { anchor, current, names, select } from "./store.js";
import { get } from "./source.js";
import { heat, residualField, scatter } from "./plots.js";

/** A view whose content is fetched once for each solution and question. */
class Asked {
  /** @param {any} bench */
  constructor(bench) {
    this.bench = bench;
    this.element = make("div", { class: "view page", tabindex: 0 });
    this.follow();
  }

  question() { return ""; }

  async follow() {
    const key = `${this.bench.state.version}/${this.question()}`;
    if (key === this.key) return;
    this.key = key;
    this.element.setAttribute("aria-busy", "true");
    try {
      const parts = await this.parts();
      if (this.key === key) this.element.replaceChildren(...parts);
    } catch (error) {
      this.element.replaceChildren(make("p", { class: "warn" }, error.message));
    }
    this.element.removeAttribute("aria-busy");
  }
}

export class CameraView extends Asked {
  question() { return `${this.camera()}/${this.against ?? ""}/${this.distance ?? ""}`; }

  camera() {
    const { kind, ids } = current(), cameras = Object.keys(this.bench.sizes);
    const said = kind === "camera" ? ids[0] : kind === "image" ? ids[0].split("/")[0] : kind === "obs" ? names(ids[0]).ids[0] : kind === "param" && ids[0].startsWith("lens/") ? ids[0].split("/")[1] : "";
    if (cameras.includes(said)) this.last = said;
    return this.last ?? cameras[0];
  }

  async parts() {
    const camera = this.camera(), size = this.bench.sizes[camera], { field, coverage } = residualField(this.bench.points, camera, size);
    const plots = make("div", { class: "figures" }, heat(t("Residual field: mean vectors over the root mean square"), field), heat(t("Coverage: image points"), coverage));
    const choose = make("select", { "aria-label": t("Camera"), onchange: (event) => select("camera", event.target.value) }, ...Object.keys(this.bench.sizes).map((id) => make("option", { value: id, selected: id === camera }, id)));
    const distance = make("input", { type: "number", min: "0.01", step: "any", value: this.distance ?? "", placeholder: "∞", "aria-label": t("distance, m"), onchange: () => { this.distance = distance.value; this.follow(); } });
    const others = make("select", { "aria-label": t("difference to"), onchange: () => { this.against = others.value; this.follow(); } },
      make("option", { value: "" }, t("before the last change")), ...(this.bench.runs ?? []).map((run) => make("option", { value: run.run, selected: String(run.run) === this.against }, `${t("run")} ${run.run}`)));
    const said = make("p", { class: "warn" });
    for (const [what, title] of [["distortion", t("Distortion: what the lens moves")], ["uncertainty", t("Uncertainty of projection (one sigma)")], ["difference", t("Difference of two lens results, implied rotation fitted")]]) {
      const ask = new URLSearchParams({ ...(this.distance ? { distance: this.distance } : {}), ...(what === "difference" && this.against ? { run: this.against } : {}) });
      get(`camera/${encodeURIComponent(camera)}/${what}?${ask}`).then((grid) => plots.append(heat(grid.text ? `${title}: ${grid.text}` : title, { size, ...grid })), (error) => { if (what !== "difference" || this.against) said.textContent = error.message; });
    }
    return [make("div", { class: "bar" }, choose, make("label", {}, t("distance, m"), " ", distance), make("label", {}, t("difference to"), " ", others)), plots, said];
  }
}

export class TableAnglesView extends Asked {
  async parts() {
    const { axes, limit } = await get("angles");
    if (!axes.length) return [make("p", { class: "quiet" }, t("No turntable in this survey."))];
    return axes.map((axis) => scatter(`${axis.table} ${axis.axis}`, axis.series.map((s) => ({ ...s, name: known(s.name), anchors: s.ids?.map((id) => ["reading", id]) })),
      { x: `${axis.over ?? axis.axis} [deg]`, y: `w`, band: limit, onpick: select }));
  }
}

export class LoopsView extends Asked {
  async parts() {
    const { loops } = await get("loops");
    if (!loops.length) return [make("p", { class: "quiet" }, t("No loops: the survey measures no pairs."))];
    return [make("h2", {}, t("Loops")), plainTable(t("Loops"), [t("loop"), t("misclosure"), t("sigma"), t("in sigmas"), ""],
      loops.map((loop) => [loop.text, `${significant(loop.misclosure, 3)} ${loop.unit}`, `${significant(loop.sigma, 3)} ${loop.unit}`, number(loop.share, 2), make("span", {}, ...(loop.pairs ?? []).flatMap((pair) => [link(anchor("reading", `pairs:${pair}`), pair), " "]))]), [1, 2, 3])];
  }
}

export class CorrelationsView extends Asked {
  async parts() {
    const { correlated, weak } = await get("statistics/correlations");
    const name = (id) => link(anchor("param", id), id);
    return [make("h2", {}, t("Correlations"), " ", make("span", { class: "quiet" }, count(correlated.length))),
      plainTable(t("Correlations"), [t("parameter"), t("parameter"), t("correlation")], correlated.slice(0, 300).map((c) => [name(c.a), name(c.b), number(c.correlation, 4)]), [2]),
      make("h2", {}, t("Weak directions")),
      ...(weak ?? []).slice(0, 8).map((w) => make("p", {}, make("b", {}, `× ${significant(w.inflation, 3)}`), "  ", Object.entries(w.parts).slice(0, 6).map(([id, share]) => `${id} ${number(share, 3)}`).join("   ")))];
  }
}

