// The header: what the solution is worth, and what may be done with it.

import { button, by, fill, make } from "./dom.js";
import { count, known, number, spoken, t } from "./words.js";

/** @param {string} verdict passed, check or failed */
export const verdictText = (verdict) => ({ passed: `✓ ${t("verdict passed")}`, check: `! ${t("verdict check")}`, failed: `✕ ${t("verdict failed")}` })[verdict] ?? known(verdict);

/** @param {any} state @param {any} actions @param {{keys: () => void, language: () => void}} page */
export function drawHeader(state, actions, page) {
  by("title").textContent = state.title;
  document.title = `${state.title} · labsurvey`;
  const none = !state.known && (state.waiting || state.empty);
  by("verdict").className = none ? "" : state.verdict;
  by("verdict").textContent = none ? "" : verdictText(state.verdict);
  const fact = (name, value) => make("span", {}, make("span", { class: "quiet" }, `${name} `), value);
  fill(by("facts"), ...(state.known ? [fact("sigma0", number(state.sigma0, 4)), fact(t("redundancy"), count(state.redundancy))] : []),
    fact(t("excluded"), count(state.exclusions.length)), state.n_not_used ? fact(t("not used"), count(state.n_not_used)) : null, state.unsaved ? fact(t("unsaved"), count(state.unsaved)) : null, state.read_only ? make("span", { class: "pill" }, t("for reading only")) : null);
  if (by("doing").dataset.language !== spoken()) drawButtons(actions, page);
  for (const [id, labels] of [["undo", state.undo], ["redo", state.redo]]) Object.assign(by(id), { disabled: !labels.length || state.read_only, title: labels[0] ?? "" });
  by("save").disabled = state.read_only;
}

/** Words, and signs in their place where there is little room. */
function drawButtons(actions, page) {
  const doing = (id, text, sign, key, act) => button(text, act, key, { id, data: { sign }, "aria-label": text, class: id === "save" ? "primary" : null });
  by("doing").dataset.language = spoken();
  by("doing").setAttribute("aria-label", t("Actions"));
  by("doing").replaceChildren(make("output", { id: "working", class: "working", hidden: true }),
    doing("adjust", t("Adjust"), "⟳", "a", () => actions.adjust("warm")), doing("undo", t("Undo"), "↶", "u", () => actions.undo()), doing("redo", t("Redo"), "↷", "U", () => actions.redo()), doing("save", t("Save"), "⤓", "s", () => actions.save()),
    button(spoken() === "en" ? "DE" : "EN", page.language, "g", { "aria-label": t("language") }), button("?", page.keys, "?", { "aria-label": t("Keys") }));
}

/** What goes on just now. @param {string} text */
export function working(text) { by("working").textContent = text; by("working").hidden = !text; }
