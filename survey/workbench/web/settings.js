// What the survey rests on: its datum, the groups of sigmas, and what is held.

import { button, fill, link, make, plainTable } from "./dom.js";
import { count, groupName, measure, number, t } from "./words.js";
import { anchor } from "./store.js";

const MOST = 200;

export class SettingsView {
  /** @param {any} bench @param {any} actions */
  constructor(bench, actions) {
    this.bench = bench;
    this.actions = actions;
    this.element = make("div", { class: "view page", tabindex: 0 });
    this.chosen = null;
    this.follow();
  }

  follow() {
    const { state, findings, parameters } = this.bench;
    if (this.drawn === parameters) return;
    this.drawn = parameters;
    const held = parameters.filter((p) => p.treatment === "held");
    fill(this.element, make("h2", {}, t("Datum")), this.datum(state), make("h2", {}, t("Groups")), this.groups(findings.groups ?? [], state),
      make("h2", {}, t("Held"), " ", make("span", { class: "quiet" }, count(held.length))),
      make("p", { class: "quiet" }, t("Choose a parameter in its table to free it or to hold it.")),
      held.length ? plainTable(t("Held"), [t("parameter"), t("value")], held.slice(0, MOST).map((p) => [link(anchor("param", p.name), p.name), measure(p.value, p.unit, 7)]), [1]) : null);
  }

  /** Given by what is held, or inner constraints over the points and stations that are chosen (none: all). What is chosen and not set yet stays when values arrive. */
  datum(state) {
    const { tree } = state, datum = this.chosen ?? state.datum;
    const choose = () => { over.hidden = kind.value !== "inner"; this.chosen = { kind: kind.value, points: all(points), stations: all(stations) }; };
    const choices = (title, ids, chosen) => make("select", { multiple: true, size: Math.min(8, Math.max(2, ids.length)), "aria-label": title, onchange: choose }, ...ids.map((id) => make("option", { value: id, selected: chosen.includes(id) }, id)));
    const points = choices(t("Points"), tree.points, datum.points), stations = choices(t("Stations"), tree.stations, datum.stations);
    const over = make("div", { class: "actions", hidden: datum.kind !== "inner" }, tree.points.length ? make("label", {}, t("Points"), " ", points) : null, tree.stations.length ? make("label", {}, t("Stations"), " ", stations) : null);
    const kind = make("select", { "aria-label": t("Datum"), onchange: choose },
      make("option", { value: "given", selected: datum.kind === "given" }, t("datum given")), make("option", { value: "inner", selected: datum.kind === "inner" }, t("datum inner")));
    const all = (field) => (kind.value === "inner" ? [...field.selectedOptions].map((o) => o.value) : []);
    return make("div", {}, kind, over, state.read_only ? null : make("div", { class: "actions" }, button(t("Set"), () => { this.chosen = null; this.actions.setting({ datum: kind.value, points: all(points), stations: all(stations) }); }, "", { id: "set-datum" })));
  }

  groups(groups, state) {
    const field = (g) => { const input = make("input", { type: "number", min: "0", step: "any", value: "1", "aria-label": `${t("sigmas times")} ${g.id}` }); return make("span", {}, input, " ", button(t("Set"), () => this.actions.setting({ group: g.id, factor: Number(input.value) }), "", { "aria-label": `${t("Set")} ${g.id}` })); };
    return plainTable(t("Groups"), [t("group"), t("observations"), t("sigmas fit ×"), t("sigmas times")], groups.map((g) => [groupName(g.id), count(g.n), number(g.scale, 3), state.read_only ? "" : field(g)]), [1, 2]);
  }
}
