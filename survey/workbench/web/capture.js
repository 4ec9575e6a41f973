// A capture session in the project's folder as it goes on: how far it is, last images with what was seen in them, coverage.

import { fill, make } from "./dom.js";
import { t } from "./words.js";
import { captured, get } from "./source.js";
import { Cameras, progress } from "./cameras.js";

const EVERY_MS = 700;

export class CaptureView {
  constructor() {
    this.cameras = new Cameras(captured);
    this.head = make("div", { class: "bar" });
    this.element = make("div", { class: "view page capture", tabindex: 0 }, this.head, this.cameras.element);
    this.look();
  }

  follow() {}

  whole() { for (const view of this.cameras.views) view.whole(); }

  /** Again and again while the view is in the page. */
  async look() {
    try {
      this.show(await get("capture"));
    } catch (error) { fill(this.head, make("p", { class: "warn" }, error.message)); }
    setTimeout(() => { if (this.element.isConnected) this.look(); }, EVERY_MS);
  }

  show(status) {
    const { state, kind, share, epochs, left } = progress(status), idle = status.state === "not started" && !status.total;
    const said = JSON.stringify([state, epochs, left, status.message]);
    if (said !== this.said) fill(this.head, make("output", { class: kind, "aria-live": "polite" }, state), ...(idle ? [] : [make("progress", { max: 1, value: share, "aria-label": epochs }), make("span", {}, epochs + left)]), status.message ? make("p", { class: "warn" }, status.message) : null, idle ? make("p", { class: "quiet" }, t("No capture session has written to this folder yet. labcapture run PLAN begins one; its images, their quality and what they cover appear here as they come.")) : null);
    this.said = said;
    this.cameras.show(status);
  }
}
