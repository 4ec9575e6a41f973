// What is wrong, worst first: verdict, warnings, suspects with their probable cause and what may be done about them.

import { button, by, link, make, plainTable } from "./dom.js";
import { count, known, number, t } from "./words.js";
import { anchor, current, select } from "./store.js";
import { placeOf } from "./tree.js";

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
    this.element.replaceChildren(
      make("p", { class: `verdict ${state.verdict}` }, make("b", {}, verdictText(state.verdict)), " ", make("span", {}, state.reason ?? "")),
      (findings.warnings ?? []).length ? make("ul", { class: "problems" }, ...findings.warnings.map((text) => make("li", {}, text))) : null,
      ...causes.map((cause) => this.cause(cause)),
      make("h2", {}, t("Suspects"), " ", make("span", { class: "quiet" }, count(findings.n_suspects ?? suspects.length))),
      suspects.length ? this.suspects(suspects) : make("p", { class: "quiet" }, t("Nothing disagrees with the others.")),
      state.exclusions.length ? this.exclusions(state.exclusions) : "",
      (findings.groups ?? []).length ? make("h2", {}, t("Groups")) : "",
      (findings.groups ?? []).length ? this.groups(findings.groups) : "");
  }

  cause(cause) {
    const remedies = (cause.remedies ?? []).map((remedy) => make("li", {}, remedy.text ?? remedy.title ?? "", " ",
      remedy.apply && !this.bench.state.read_only ? button(t("apply"), () => this.actions.remedy(remedy), "") : null));
    return make("section", { class: "cause" }, make("h3", {}, cause.title ?? cause.text), cause.text && cause.title ? make("p", {}, cause.text) : null, remedies.length ? make("ul", {}, ...remedies) : null);
  }

  suspects(rows) {
    const table = plainTable(t("Suspects, worst first"), [t("observation"), "w", t("share of limit"), "r", t("detectable error"), t("cause")],
      rows.map((s) => [make("a", { href: anchor(...s.place), data: { id: s.place[1] } }, `${known(s.kind)} ${s.text}`), number(s.w, 2), make("span", { class: "share", data: { share: Math.min(3, s.share) } }, `${number(100 * s.share, 0)} %`), number(s.redundancy, 2), s.detectable ?? "–", s.cause ?? ""]), [1, 2, 3, 4]);
    return table;
  }

  groups(rows) {
    return plainTable(t("Groups"), [t("group"), t("observations"), t("redundancy"), t("sigmas fit ×"), t("state")],
      rows.map((g) => [link(anchor("group", g.id), known(g.id)), count(g.n), number(g.redundancy, 1), number(g.scale, 3), g.state ?? ""]), [1, 2, 3]);
  }

  exclusions(rows) {
    return make("div", {}, make("h2", {}, t("Excluded by people"), " ", make("span", { class: "quiet" }, count(rows.length))),
      plainTable(t("Excluded by people"), [t("what"), t("reason"), t("who"), t("fits now"), ""],
        rows.map((row) => [link(anchor(...placeOf(row.what, row.id)), `${t(`kind ${row.what}`)} ${row.id}`), row.reason || t("no reason given"), row.author ?? "", row.w === null || row.w === undefined ? "–" : `w ${number(row.w, 2)}`,
          this.bench.state.read_only ? null : button(t("take back"), () => this.actions.include([`${row.what}:${row.id}`]), "e")]), [3]));
  }

  /** The next or previous suspect is looked at. @param {number} by */
  step(by) {
    const suspects = this.bench.findings.suspects ?? [], at = suspects.findIndex((s) => current().ids.includes(s.place[1]));
    const next = suspects[at < 0 ? (by > 0 ? 0 : suspects.length - 1) : at + by];
    if (next) select(next.place[0], next.place[1], true);
  }
}

/** @param {string} verdict passed, check or failed */
export const verdictText = (verdict) => ({ passed: `✓ ${t("verdict passed")}`, check: `! ${t("verdict check")}`, failed: `✕ ${t("verdict failed")}` })[verdict] ?? known(verdict);

/** The header: what the solution is worth. @param {any} state */
export function drawHeader(state) {
  by("title").textContent = state.title;
  document.title = `${state.title} · labsurvey`;
  by("verdict").className = state.verdict;
  by("verdict").textContent = verdictText(state.verdict);
  const fact = (name, value) => make("span", {}, make("span", { class: "quiet" }, `${name} `), value);
  by("facts").replaceChildren(fact("sigma0", number(state.sigma0, 4)), fact(t("redundancy"), count(state.redundancy)),
    fact(t("left out"), count(state.exclusions.length)), state.unsaved ? fact(t("unsaved"), count(state.unsaved)) : "", state.read_only ? make("span", { class: "pill" }, t("for reading only")) : "");
}

