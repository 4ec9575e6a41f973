// A folder of images that is no project yet: what is in it, and how a project begins there.

import { button, by, fill, make, plainTable } from "./dom.js";
import { count, t } from "./words.js";
import { post } from "./source.js";

/** @param {any} raw the state of a folder without a survey.toml @param {any} actions */
export function drawBeginning({ folder, read_only, beginning }, actions) {
  by("title").textContent = t("New project");
  const field = make("input", { type: "text", value: beginning.folder, "aria-label": t("folder of the project"), size: 50 });
  const begin = () => actions.job("init", () => post("jobs/init", { images: beginning.images, folder: field.value.trim() }));
  fill(by("left"), make("div", { class: "view page", tabindex: 0 },
    make("p", {}, t("{folder} holds images and no survey.toml.", { folder })),
    plainTable(t("Cameras"), [t("camera"), t("Images")], Object.entries(beginning.cameras).map(([name, n]) => [name, count(n)]), [1]),
    make("p", { class: "quiet" }, t("Sizes and boards are read out of the images, and a survey.toml with comments is written. Images that lie in the project already stay where they are; others are copied.")),
    make("form", { class: "actions", onsubmit: (event) => { event.preventDefault(); begin(); } }, make("label", {}, t("folder of the project"), " ", field), button(t("Begin the project"), begin, "", { id: "begin", class: "primary", disabled: read_only }))));
  document.body.dataset.ready ??= String(Math.round(performance.now()));
}
