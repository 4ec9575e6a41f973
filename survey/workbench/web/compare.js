// Before and after of every parameter, the runs that were kept, and any two of them compared.

import { Asked } from "./asked.js";
import { button, link, make, plainTable } from "./dom.js";
import { count, number, significant, t, time } from "./words.js";
import { anchor, current, go } from "./store.js";
import { get, post } from "./source.js";
import { tell } from "./dialogs.js";

const MOST = 300;

/** @param {any} changes before, after, new, gone, components: name, unit, before, after, difference, sigmas, ratio */
export function changesText(changes) {
  const { before: a, after: b } = changes;
  const fact = (title, x, y) => make("div", {}, make("span", { class: "quiet" }, title), make("b", {}, x === y ? x : `${x} → ${y}`));
  const rows = changes.components.slice(0, MOST).map((c) => [
    make("span", {}, link(anchor("param", c.name), c.name), c.before === null ? null : make("div", { class: "quiet" }, `${significant(c.before, 7)} → ${significant(c.after, 7)}`)),
    number(c.sigmas, 2), `${c.difference > 0 ? "+" : ""}${significant(c.difference, 3)} ${c.unit}`, number(c.ratio, 3)]);
  return make("div", {},
    make("div", { class: "cards" }, fact(t("verdict"), t(`verdict ${a.verdict}`), t(`verdict ${b.verdict}`)), fact("sigma0", number(a.sigma0, 4), number(b.sigma0, 4)),
      fact(t("redundancy"), count(a.redundancy), count(b.redundancy)), fact(t("suspects"), count(a.n_suspects ?? 0), count(b.n_suspects ?? 0))),
    changes.gone?.length ? make("p", {}, t("Only before: {names}", { names: changes.gone.join(", ") })) : null,
    changes.new?.length ? make("p", {}, t("Only after: {names}", { names: changes.new.join(", ") })) : null,
    plainTable(t("Before and after"), [`${t("parameter")}: ${t("before")} → ${t("after")}`, t("in sigmas"), t("difference"), t("sigma ratio")], rows, [1, 2, 3]),
    make("p", { class: "quiet" }, t("{n} components, the one that moved by most of its sigmas first", { n: count(changes.n_components ?? changes.components.length) })));
}

/** The same in one line. @param {any} changes null where there was nothing before */
export function changedShortly(changes) {
  const first = changes?.components?.[0];
  return first ? ` sigma0 ${number(changes.before.sigma0, 4)} → ${number(changes.after.sigma0, 4)}; ${t("largest change")} ${first.name} ${number(first.sigmas, 2)} σ` : "";
}

export class CompareView extends Asked {
  question() { return `${current().run}/${current().against}`; }

  async parts() {
    const { run, against } = current(), { state } = this.bench;
    const { runs } = await get("runs"), asked = new URLSearchParams(Object.entries({ a: against, b: run }).filter(([, number]) => number));
    const changes = against ? await get(`compare?${asked}`) : state.changes;
    const title = !against ? t("Before and after the last change") : run ? t("Run {a} → run {b}", { a: against, b: run }) : t("Run {a} → now", { a: against });
    const nothing = make("p", { class: "quiet" }, t("Nothing has been changed yet. Leave something out (x), or choose a run."));
    return [runs.length ? this.chooser(runs, run, against) : null, changes ? [make("h2", {}, title), changesText(changes)] : nothing];
  }

  /** Which run is before, and which after: none is what the page shows now. */
  chooser(runs, run, against) {
    const field = (name, chosen, none, to) => { const select = make("select", { "aria-label": name, onchange: () => go(to(select.value), true) }, make("option", { value: "" }, none), ...runs.map((r) => make("option", { value: r.number, selected: String(r.number) === String(chosen) }, `${r.number}  ${time(r.time)}`))); return make("label", {}, name, " ", select); };
    return make("div", { class: "actions" }, field(t("before"), against, t("the last change"), (against) => ({ against })), field(t("after"), run, t("now"), (run) => ({ run })));
  }
}

export class HistoryView extends Asked {
  question() { return `${this.bench.state.unsaved}/${current().run}`; }

  async parts() {
    const { runs } = await get("runs");
    const { state } = this.bench, chosen = current();
    const pick = (name, run) => make("input", { type: "radio", name, "aria-label": `${t(name)} ${run}`, checked: String(chosen[name === "before" ? "against" : "run"]) === String(run), onchange: () => go(name === "before" ? { against: String(run) } : { run: String(run) }, true) });
    const acts = (run) => (state.read_only ? null : make("span", { class: "actions" }, button(run.pinned ? "★" : "☆", () => this.act("pin", run), "", { "aria-label": `${run.pinned ? t("not kept for ever") : t("keep for ever")}: ${run.number}` }), " ", button(t("restore"), () => this.act("restore", run), "", { "aria-label": `${t("restore")}: ${run.number}` })));
    const rows = runs.map((run) => [pick("before", run.number), pick("after", run.number), link(`#run=${run.number}`, String(run.number)), t(`verdict ${run.summary.verdict}`), number(run.summary.sigma0, 4),
      make("div", { class: "wide" }, time(run.time), " ", make("span", { class: "quiet" }, [`${t("redundancy")} ${count(run.summary.redundancy)}`, run.author, run.command].filter(Boolean).join(" · ")), acts(run))]);
    const steps = (title, labels) => labels?.length ? make("div", {}, make("h3", {}, title), make("ol", {}, ...labels.map((label) => make("li", {}, label)))) : null;
    return [make("h2", {}, t("History")), steps(t("Can be undone"), state.undo), steps(t("Can be done again"), state.redo), make("h3", {}, t("Runs")),
      rows.length ? plainTable(t("Runs"), [t("before"), t("after"), t("run"), t("verdict"), "sigma0", t("time, who, command")], rows, [4]) : make("p", { class: "quiet" }, t("No runs are kept yet; Save writes one.")),
      rows.length > 1 ? button(t("Compare"), () => this.compare(), "d", { class: "primary" }) : null];
  }

  compare() {
    const { run, against } = current();
    if (run && against) this.actions.show("compare");
    else tell(t("Choose one run as before and one as after."));
  }

  async act(what, run) {
    try { await this.actions.done(await post(`runs/${run.number}/${what}`, { base: this.bench.state.version, pinned: !run.pinned })); } catch (error) { tell(error.message, "warn"); }
    await this.again();
  }
}
