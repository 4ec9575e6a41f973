// A view that asks the server: once for each solution and question, and what comes late is of no question any more.

import { make } from "./dom.js";
import { t } from "./words.js";

export class Asked {
  /** @param {any} bench @param {any} [actions] */
  constructor(bench, actions) {
    Object.assign(this, { bench, actions, element: make("div", { class: "view page", tabindex: 0 }) });
    this.follow();
  }

  /** What the content depends on beside the solution. */
  question() { return ""; }

  /** The content. @returns {Promise<any[]>} */
  async parts() { return []; }

  /** Whether nothing can be said without a solution. */
  get needs() { return false; }

  /** What is added to it once it is shown. */
  async more() {}

  async follow() {
    const key = `${this.bench.state.version}/${this.question()}`;
    if (key === this.key) return;
    this.key = key;
    this.element.setAttribute("aria-busy", "true");
    if (!this.element.childElementCount) this.element.replaceChildren(make("p", { class: "quiet" }, t("computing …")));
    let parts;
    if (this.needs && !this.bench.state.solved) parts = [make("p", { class: "quiet" }, t("Known once the survey is adjusted."))];
    else try { parts = await this.parts(); } catch (error) { parts = [make("p", { class: "warn" }, error.message)]; }
    if (this.key !== key) return;
    this.element.replaceChildren(...parts.flat().filter(Boolean));
    await this.more();
    if (this.key === key) this.element.removeAttribute("aria-busy");
  }

  /** Asked anew, whatever it was. */
  again() { this.key = null; return this.follow(); }
}
