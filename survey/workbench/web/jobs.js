// The other jobs of a project: what they ask, what they said, what of it is drawn in the scene, pictures as they come.

import { button, fill, make, plainTable } from "./dom.js";
import { count, number, t } from "./words.js";
import { verdictText } from "./header.js";
import { go, select } from "./store.js";
import { picture, post } from "./source.js";

const MOST = 60; // pictures shown at once

/** Name, title, what it does, and its fields: key, label, kind (text, number, flag, words), what stands there first or, of a text, what for example could. */
const JOBS = [
  ["init", "New project", "Begin a project with a folder of images; cameras, sizes and boards are read out of them, and it is shown here.", [["images", "folder of images", "text", "recordings"], ["folder", "folder of the new project", "text", "lab-2"]]],
  ["detect", "Detect", "Find targets in images that are new or have changed, and adjust.", [["all", "all images anew", "flag", false]]],
  ["plan", "Planning", "What to measure next, of what plan.toml lists; drawn in the scene.", [["wanted", "to become precise", "text", "point/B07"], ["add", "candidates to choose", "number", 5], ["navigation", "poses from beacons", "flag", false]]],
  ["navigate", "Navigate", "A pose for every epoch that shows beacons and no target; drawn in the scene.", [["station", "station", "text", "head"], ["interval_s", "seconds between epochs", "number", 0]]],
  ["add", "Add", "Let the network grow by another folder, and adjust.", [["folder", "folder", "text", "new-stations"]]],
  ["compare", "Compare epochs", "What moved since another folder of the same laboratory; drawn in the scene.", [["folder", "folder", "text", "lab-2025"]]],
  ["show", "Other project", "Another project folder on this page instead of this one.", [["folder", "folder", "text", "lab-2"]]],
  ["batch", "Batch", "Adjust several projects; none named: all beside this one.", [["folders", "folders", "words", "lab-1 lab-2"]]],
];

export class JobsView {
  /** @param {any} bench `told`: by job, what it said last; `arrived`: images with what was just found in them @param {any} actions */
  constructor(bench, actions) {
    this.bench = bench;
    this.actions = actions;
    this.element = make("div", { class: "view page jobs", tabindex: 0 });
    this.draw();
  }

  follow() { if (this.drawn !== this.bench.toldAt) this.draw(); }

  draw() {
    this.drawn = this.bench.toldAt;
    this.strip = make("div", { class: "arrived", "aria-label": t("Images just looked at") });
    fill(this.element, ...JOBS.map((job) => this.job(job)));
    for (const found of this.bench.arrived) this.arrive(found);
  }

  job([name, title, does, fields]) {
    const inputs = fields.map(([key, label, kind, first]) => ({ key, kind, label, input: make("input", kind === "flag" ? { type: "checkbox", checked: first } : { ...(kind === "number" ? { type: "number", min: "0", step: "any", value: first } : { type: "text", placeholder: first }), "aria-label": `${t(title)}: ${t(label)}` }) }));
    const told = this.bench.told[name];
    return make("section", { "aria-label": t(title) }, make("h2", {}, t(title)), make("p", { class: "quiet" }, t(does)),
      make("div", { class: "actions" }, ...inputs.map(({ label, input }) => make("label", {}, t(label), " ", input)),
        button(t("Run"), () => this.run(name, Object.fromEntries(inputs.map(({ key, kind, input }) => [key, valueOf(kind, input)]))), "", { "aria-label": `${t("Run")}: ${t(title)}`, disabled: this.bench.state.read_only && !["compare", "show"].includes(name) })),
      name === "detect" ? this.strip : null, told?.summary.rows ? this.overview(told.summary.rows) : told ? make("pre", { class: "told" }, told.text) : null,
      told && hasDrawing(told.drawn) ? button(t("Show in the scene"), () => { this.bench.drawn = told.drawn; this.actions.show("scene"); }) : null);
  }

  /** The projects of a batch, those that failed first, each a click away. */
  overview(rows) {
    const of = (row) => ["failed", "test_failed", "done"].indexOf(row.state), short = (folder) => folder.split(/[\\/]/).filter(Boolean).at(-1);
    return plainTable(t("Batch"), [t("folder"), t("verdict"), "sigma0", t("redundancy"), "", ""], [...rows].sort((a, b) => of(a) - of(b)).map((row) => [make("span", { title: row.folder }, short(row.folder)), make("span", { class: row.state === "done" ? "" : "bad" }, verdictText(row.verdict ?? "failed")),
      number(row.sigma0, 4), number(row.redundancy, 0), make("span", { class: "wide" }, row.error.split("\n")[0]), button(t("Open"), () => this.run("show", { folder: row.folder }), "", { "aria-label": `${t("Open")}: ${short(row.folder)}` })]), [2, 3]);
  }

  async run(name, asked) {
    if (name === "detect") { this.bench.arrived = []; this.strip.replaceChildren(); }
    await this.actions.job(name, () => post(`jobs/${name}`, asked));
    if (name === "init" || name === "show") go({ kind: "", ids: [] }); // what was chosen is of the other project
    this.draw();
  }

  /** A picture of an image that was just looked at, with what was found in it. */
  async arrive(found) {
    const canvas = make("canvas", { width: 160, height: 120, "aria-hidden": "true" });
    const place = make("button", { type: "button", class: "frame", title: found.message, onclick: () => { select("image", found.image); this.actions.show("image"); } }, canvas, make("span", { class: found.status === "found" ? "" : "bad" }, `${found.image} ${found.status === "found" ? count(found.n) : "✕"}`));
    this.strip.prepend(place);
    while (this.strip.childElementCount > MOST) this.strip.lastChild.remove();
    try {
      const bitmap = await picture(found.image, 240), context = canvas.getContext("2d"), [width, height] = found.size ?? [bitmap.width, bitmap.height];
      const scale = Math.min(160 / width, 120 / height);
      context.drawImage(bitmap, 0, 0, width * scale, height * scale);
      context.fillStyle = "#2fd3a6";
      for (const [u, v] of found.uv) context.fillRect(u * scale - 1, v * scale - 1, 2.5, 2.5);
    } catch { /* its name stays */ }
  }
}

const hasDrawing = (drawn) => drawn.scene || drawn.path.length || drawn.points.length || drawn.lines.length || Object.keys(drawn.cameras).length;

function valueOf(kind, input) {
  if (kind === "flag") return input.checked;
  if (kind === "number") return Number(input.value) || 0;
  return kind === "words" ? input.value.split(/[\s,]+/).filter(Boolean) : input.value.trim();
}
