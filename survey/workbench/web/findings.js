// What is wrong, worst first: verdict, warnings, suspects with their probable cause and what may be done about them.

import { button, fill, link, make, plainTable } from "./dom.js";
import { count, groupName, number, significant, t, time } from "./words.js";
import { anchor, current, select } from "./store.js";
import { rowOf, rowsOfImage } from "./columns.js";
import { post } from "./source.js";
import { verdictText } from "./header.js";
import { placeOf } from "./tree.js";

/** A link to what an anchor names, whose picture is fetched when it is pointed at. */
const place = (to, id = decodeURIComponent(to.replace(/^#\w+=/, "")), text = id) => [" ", link(to, text, { data: { id } })];
/** The places that a message names. */
const places = (said) => said.anchors.flatMap((to) => place(to));

export class FindingsView {
  /** @param {any} bench @param {any} actions */
  constructor(bench, actions) {
    this.bench = bench;
    this.actions = actions;
    this.element = make("div", { class: "view page", tabindex: 0 });
    this.follow();
  }

  follow() {
    const { state, findings } = this.bench;
    if (this.drawn !== findings) { this.drawn = findings; this.draw(state, findings); }
    const { ids } = current();
    for (const row of this.element.querySelectorAll("[data-id]")) row.classList.toggle("here", ids.includes(row.dataset.id));
    this.element.querySelector(".here")?.scrollIntoView({ block: "nearest" });
  }

  draw(state, findings) {
    const suspects = findings.suspects ?? [], causes = findings.causes ?? [];
    fill(this.element, 
      state.empty && !state.known ? this.begin(state) : state.waiting && !state.known ? make("p", { class: "verdict" }, t("adjusting …")) : make("p", { class: `verdict ${state.verdict}` }, make("b", {}, verdictText(state.verdict)), " ", make("span", {}, state.reason ?? "")),
      state.waiting && state.known ? make("p", { class: "quiet" }, t("As saved {time}; it is being adjusted again.", { time: time(state.date) })) : null,
      ...causes.map((cause) => this.cause(cause)),
      findings.remedies?.length ? make("h2", {}, t("What would mend it")) : null,
      ...(findings.remedies ?? []).map((remedy) => this.remedy(remedy)),
      (findings.warnings ?? []).length ? make("ul", { class: "problems" }, ...findings.warnings.map((w) => make("li", {}, w.text, ...places(w)))) : null,
      state.known ? make("h2", {}, t("Suspects"), " ", make("span", { class: "quiet" }, count(findings.n_suspects ?? suspects.length))) : null,
      !state.known ? null : suspects.length ? this.suspects(t("Suspects, worst first"), suspects) : make("p", { class: "quiet" }, t("Nothing disagrees with the others.")),
      state.exclusions.length ? this.exclusions(state.exclusions) : null,
      (findings.groups ?? []).length ? make("h2", {}, t("Groups")) : null,
      (findings.groups ?? []).length ? this.groups(findings.groups) : null,
      findings.largest?.length ? make("h2", {}, t("Largest within the limit")) : null,
      findings.largest?.length ? this.suspects(t("Largest within the limit"), findings.largest) : null);
  }

  /** What to do first, where nothing is observed yet. */
  begin(state) {
    const n = count(this.bench.images.length), looked = count(state.n_looked_at);
    const said = !this.bench.images.length ? t("Nothing is observed yet. Put images at images/CAMERA/EPOCH.png or tables into observations/; this page tells when they are there.")
      : state.n_looked_at ? t("No target was found in {n} images. Compare the targets in survey.toml with what the images show, and detect again.", { n: looked })
        : t("{n} images, and nothing was looked for in them yet.", { n });
    return make("div", { class: "next" }, make("h2", {}, t("Next step")), make("p", {}, said), this.bench.images.length && !state.read_only ? make("p", {}, button(t("Detect"), () => this.detect(state.n_looked_at > 0), "", { class: "primary" })) : null);
  }

  /** The pictures come in under Jobs. */
  detect(all) {
    this.actions.show("jobs", "left");
    this.actions.job("detect", () => post("jobs/detect", { all }));
  }

  cause(cause) { return make("p", { class: "cause" }, make("b", {}, t("Probable cause")), " ", cause.text, ...places(cause)); }

  /** A cause that was tried: what it explains, and one click that carries it out. */
  remedy(r) {
    const evidence = t("explains {share} % of the misfit; sigma0 becomes {sigma0}; test {test}, limit {limit}; probability {sure} %", { share: number(100 * r.explained, 0), sigma0: number(r.sigma0, 3), test: significant(r.statistic, 3), limit: significant(r.critical, 3), sure: number(100 * r.probability, 0) });
    return make("div", { class: "cause remedy" }, make("p", {}, make("b", {}, `${r.number}. ${r.cause}`), "; ", r.change, r.where ? [" ", make("code", {}, r.where)] : null, r.anchor ? place(r.anchor, undefined, t("show")) : null), make("p", { class: "quiet" }, evidence),
      this.bench.state.read_only ? null : r.possible ? button(t("Apply"), () => this.actions.remedy(r.number), r.number === 1 ? "m" : "", { "aria-label": `${t("Apply")}: ${r.cause}` }) : make("p", { class: "quiet" }, t("Only you can do that.")));
  }

  suspects(title, rows) {
    return plainTable(title, [t("observation"), "w", t("limit"), t("residual")],
      rows.map((s) => [link(s.anchor, s.kind === "image_point" ? s.text : `${t(`kind ${s.kind}`)} ${s.text}`, { data: { id: s.place[1] }, class: s.why === 0 ? null : "out", title: s.why === 0 ? null : t("left out") }),
        s.w === null ? t("{k} of {n} points", { k: s.n_points, n: s.n_in_image }) : number(s.w, 2), s.share === null ? "–" : `${number(100 * s.share, 0)}\u00a0%`, s.residual === undefined ? "–" : `${[s.residual].flat().map((x) => significant(x, 2)).join("\u00a0/ ")}\u00a0${s.unit}`]), [1, 2, 3]);
  }

  groups(rows) {
    return plainTable(t("Groups"), [t("group"), t("observations"), t("redundancy"), t("sigmas fit ×")],
      rows.map((g) => [link(anchor("group", g.id), groupName(g.id)), count(g.n), number(g.redundancy, 1), number(g.scale, 3)]), [1, 2, 3]);
  }

  exclusions(rows) {
    return make("div", {}, make("h2", {}, t("Excluded by people"), " ", make("span", { class: "quiet" }, count(rows.length))),
      plainTable(t("Excluded by people"), [t("what"), t("reason"), t("who"), t("Largest |w| now"), ""],
        rows.map((row) => [link(anchor(...placeOf(row.what, row.id)), `${t(`kind ${row.what}`)} ${row.id}`), row.reason || t("no reason given"), row.author ?? "", number(this.fits(row), 2),
          this.bench.state.read_only ? null : button(t("take back"), () => this.actions.include([`${row.what}:${row.id}`]), "e")]), [3]));
  }

  /** Largest |w| now of what is left out: small, where it would fit again. */
  fits(row) {
    const { points, readings } = this.bench, ids = row.id.split("/");
    const rows = row.what === "image_point" ? [rowOf(points, ids)] : row.what === "image" ? [...rowsOfImage(points, row.id)] : [];
    const all = row.what === "reading" ? readings.filter((r) => r.id === row.id).map((r) => Math.abs(r.w ?? NaN)) : rows.filter((i) => i >= 0).map((i) => points.w[i]);
    return all.reduce((most, w) => (w > most || !Number.isFinite(most) ? w : most), NaN);
  }

  /** The next or previous suspect is looked at. @param {number} by */
  step(by) {
    const suspects = [...(this.bench.findings.suspects ?? []), ...(this.bench.findings.largest ?? [])], at = suspects.findIndex((s) => current().ids.includes(s.place[1]));
    const next = suspects[at < 0 ? (by > 0 ? 0 : suspects.length - 1) : at + by];
    if (next) select(next.place[0], next.place[1], true);
  }
}
