// The tree of what a project has: cameras with their images, epochs, targets, points, readings, exclusions, runs.

import { by, make } from "./dom.js";
import { count, known, t } from "./words.js";
import { current, names, select } from "./store.js";

/**
 * Branches that open when asked; only open ones are in the page.
 * @param {any} bench
 */
export function drawTree(bench) {
  const { tree } = bench.state, root = by("tree"), open = new Set([...root.querySelectorAll("details[open]")].map((d) => d.dataset.branch));
  const cameras = new Map(tree.cameras.map((c) => [c.id, c.images])), epochs = new Map(tree.epochs.map((epoch) => [epoch, []])), { targets } = tree;
  for (const [camera, mine] of cameras) for (const epoch of mine) epochs.get(epoch)?.push(camera);
  const groups = new Map();
  for (const row of bench.readings) if (!groups.get(row.table)?.has(row.id)) groups.set(row.table, (groups.get(row.table) ?? new Set()).add(row.id));
  const branch = (id, title, n, fill) => {
    const inner = make("ul", { role: "group" });
    const details = make("details", { data: { branch: id } }, make("summary", {}, title, " ", make("span", { class: "quiet" }, count(n))), inner);
    const draw = () => { if (details.open && !inner.childElementCount) inner.append(...fill()); };
    details.addEventListener("toggle", draw);
    if (open.has(id) || (!root.childElementCount && id === "cameras")) { details.open = true; draw(); }
    return details;
  };
  const leaf = (kind, id, text = id, extra = "") => make("li", {}, make("button", { type: "button", class: "leaf", data: { kind, id }, onclick: () => select(kind, id) }, make("span", {}, text), extra ? make("span", { class: "quiet" }, extra) : null));
  const images = (camera) => cameras.get(camera).map((epoch) => {
    const left = bench.leftOut.get(`${camera}/${epoch}`) ?? 0;
    return leaf("image", `${camera}/${epoch}`, epoch, left ? `−${left}` : "");
  });
  root.replaceChildren(
    branch("cameras", t("Cameras"), cameras.size, () => [...cameras.keys()].map((camera) => make("li", {}, leaf("camera", camera).firstChild, branch(`camera ${camera}`, t("Images"), cameras.get(camera).length, () => images(camera))))),
    branch("epochs", t("Epochs"), epochs.size, () => [...epochs.keys()].map((epoch) => leaf("epoch", epoch, epoch, epochs.get(epoch).join(" ")))),
    branch("targets", t("Targets"), targets.length, () => targets.map((target) => leaf("target", target))),
    branch("points", t("Points"), tree.points.length, () => tree.points.map((id) => leaf("point", id))),
    branch("stations", t("Stations"), tree.stations.length, () => tree.stations.map((id) => leaf("station", id))),
    tree.tables.length ? branch("tables", t("Turntables"), tree.tables.length, () => tree.tables.map((id) => leaf("table", id))) : "",
    branch("readings", t("Readings"), [...groups.values()].reduce((sum, ids) => sum + ids.size, 0), () => [...groups].map(([table, ids]) => make("li", {}, branch(`table ${table}`, known(table.replaceAll("_", " ")), ids.size, () => [...ids].map((id) => leaf("reading", id, id.slice(table.length + 1))))))),
    branch("exclusions", t("Excluded by people"), bench.state.exclusions.length, () => bench.state.exclusions.map((row) => leaf(...placeOf(row.what, row.id), `${t(`kind ${row.what}`)} ${row.id}`))),
  );
  markTree();
}

/** Where an excluded thing is shown: kind and id of a selection. @param {string} what @param {string} id @returns {[string, string]} */
export function placeOf(what, id) {
  if (what === "image_point" || what === "spot") return ["obs", `${what}:${id}`];
  return [what, id];
}

/** The chosen thing is marked in the tree. */
export function markTree() {
  const { kind, ids } = current(), image = kind === "obs" ? names(ids[0]).ids.slice(0, 2).join("/") : "";
  for (const leaf of by("tree").querySelectorAll(".leaf")) {
    const here = (leaf.dataset.kind === kind && ids.includes(leaf.dataset.id)) || (leaf.dataset.kind === "image" && leaf.dataset.id === image);
    if (here) leaf.setAttribute("aria-current", "true");
    else leaf.removeAttribute("aria-current");
  }
}
