// The frame of the page: two panes with a view each, the parts that a phone shows one at a time, and who has the focus.

import { by, make } from "./dom.js";
import { t } from "./words.js";
import { current, go } from "./store.js";
import { bench } from "./bench.js";

export const PANES = ["left", "right"];
const REGIONS = [["tree", "Project"], ["left", "First view"], ["right", "Second view"], ["tables", "Tables"], ["inspector", "Details"]];
const shown = { left: null, right: null };
let views = {}, lastPane = "right";

/** @param {Object<string, [string, () => any]>} all views by name: title, and what makes one */
export function use(all) {
  views = all;
  for (const pane of PANES) for (const name of ["pointerdown", "focusin"]) by(pane).addEventListener(name, () => { lastPane = pane; });
  nameRegions();
}

/** Views of the two panes: from the address, else findings beside an image (without images the scene), a run in the history. */
function panes() {
  const first = ["findings", current().run ? "history" : bench.state?.tree.cameras.some((camera) => camera.images.length) ? "image" : "scene"];
  return PANES.map((_, k) => (views[current().view[k]] ? current().view[k] : first[k]));
}

/** @param {string} view @param {string|null} [pane] none: wherever it is already, else in the pane that was used last */
export function show(view, pane = null) {
  const all = panes();
  if (!pane && all.includes(view)) return;
  all[PANES.indexOf(pane ?? lastPane)] = view;
  go({ view: all });
}

/** The view before or after this one, in the pane that was used last. @param {number} by */
export function nextView(by) {
  const all = Object.keys(views), at = all.indexOf(panes()[PANES.indexOf(lastPane)]);
  show(all[(at + by + all.length) % all.length], lastPane);
}

/** The view of a sort that is in sight. */
export const viewOf = (type) => PANES.map((pane) => shown[pane]?.view).find((view) => view instanceof type);

/** Does something with each view in sight. @param {(view: any) => void} act */
export const eachView = (act) => PANES.forEach((pane) => { if (shown[pane]) act(shown[pane].view); });

export function drawPanes() { for (const pane of PANES) drawPane(pane); }

function drawPane(pane) {
  const name = panes()[PANES.indexOf(pane)];
  if (shown[pane]?.name === name) { shown[pane].view.follow(); return; }
  drawTabs();
  const chooser = make("select", { "aria-label": t("view"), onchange: () => show(chooser.value, pane) }, ...Object.entries(views).map(([id, [title]]) => make("option", { value: id, selected: id === name }, t(title))));
  shown[pane] = { name, view: views[name][1]() };
  by(pane).replaceChildren(make("div", { class: "chooser" }, chooser), shown[pane].view.element);
  by(pane).setAttribute("aria-label", t(views[name][0]));
}

/** Everything is drawn from the beginning the next time, as in another language. */
export function forget() {
  shown.left = shown.right = null;
  nameRegions();
}

function nameRegions() {
  for (const [id, title] of REGIONS) by(id).setAttribute("aria-label", t(title));
  drawTabs();
}

function drawTabs() {
  by("tabs").setAttribute("aria-label", t("Parts of the page"));
  by("tabs").replaceChildren(...REGIONS.map(([id, title]) => make("button", { type: "button", "aria-current": document.body.dataset.pane === id ? "page" : null, onclick: () => focus(id) }, t(PANES.includes(id) ? views[panes()[PANES.indexOf(id)]][0] : title))));
}

/** @param {string} region */
export function focus(region) {
  document.body.dataset.pane = region;
  drawTabs();
  if (PANES.includes(region)) lastPane = region;
  by(region).querySelector("[tabindex='0'], button, select, input")?.focus();
}
