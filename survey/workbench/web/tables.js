// The tables below the views: image points, readings, parameters, what people excluded.

import { by, make } from "./dom.js";
import { estimated, known, measure, significant, t } from "./words.js";
import { current, names, select } from "./store.js";
import { pointId, rowOf } from "./columns.js";
import { Table, named, numbers } from "./table.js";
import { placeOf } from "./tree.js";

const TABLES = { points: "Image points", readings: "Readings", parameters: "Parameters", exclusions: "Excluded by people" };
/** Tables in which a chosen thing is found. */
const TABLE_OF = { obs: "points", reading: "readings", param: "parameters" };

/** A value for each of many rows: a loop, which takes a tenth of the time of a callback. */
function each(Kind, n, value) {
  const out = new Kind(n);
  for (let i = 0; i < n; i++) out[i] = value(i);
  return out;
}

const number4 = (key, title, rows, size = false) => numbers(key, title, rows.map((r) => r[key]), { size, text: (i) => significant(rows[i][key], 6) });

export class Tables {
  /** @param {any} bench the page's values @param {any} actions `show` of a view */
  constructor(bench, actions) {
    Object.assign(this, { bench, actions, table: null, name: "points", followed: "", asked: false }); // asked: for a table by its tab
  }

  /** Drawn anew from the beginning the next time. */
  forget() { this.table = null; }

  /** The field of the filter. */
  find() { this.table?.field.focus(); this.table?.field.select(); }

  open(name) { if (name !== this.name) { this.name = name; this.table = null; } }

  draw(fresh) {
    const { kind, ids } = current(), wanted = TABLE_OF[kind];
    if (wanted) { if (this.followed !== ids[0]) this.open(wanted); } else if (!this.asked && fresh) this.open(this.bench.points.n ? "points" : "readings");
    this.followed = ids[0];
    if (!this.table) this.begin();
    else if (fresh) this.table.renew(this.data());
    const rows = { points: () => (kind === "obs" ? (ids[0]?.startsWith("image_point:") ? rowOf(this.bench.points, names(ids[0]).ids) : -1) : null),
      readings: () => (kind === "reading" ? this.bench.readings.findIndex((r) => r.id === ids[0]) : null),
      parameters: () => (kind === "param" ? this.bench.parameters.findIndex((r) => r.name === ids[0]) : null) };
    const row = rows[this.name]?.() ?? null;
    this.table.mark(row === null ? [] : ids, row ?? -1);
  }

  /** New values of one of the tables. */
  renew(name) { if (name === this.name) { this.table?.renew(this.data()); this.draw(false); } }

  begin() {
    const data = this.data(), { kind, sort } = data; // no listener may hold the rows of a solution that has gone
    this.table = new Table(t(TABLES[this.name]), data, { sort, onselect: (rows, quiet) => this.select(kind, rows, quiet), onenter: (row) => { this.select(kind, [row], false); this.actions.show("image", "right"); } });
    const tab = (name, title) => make("button", { type: "button", role: "tab", "aria-selected": name === this.name, onclick: () => { this.asked = true; this.name = name; this.table = null; this.draw(false); } }, t(title));
    by("tables").replaceChildren(make("div", { role: "tablist", "aria-label": t("Tables"), class: "tabs" }, ...Object.entries(TABLES).map(([name, title]) => tab(name, title))), this.table.element);
  }

  select(kind, rows, quiet) {
    if (!rows.length) return;
    if (kind === "exclusion") { const row = this.bench.state.exclusions[rows[0]]; select(...placeOf(row.what, row.id), quiet); }
    else select(kind, rows.slice(0, 1000).map((i) => this.table.data.id(i)), quiet);
  }

  data() { return this[this.name](); }

  points() {
    const data = this.bench.points, coded = (key) => {
      const found = [...new Set(data.blocks.map((b) => b[key] ?? ""))], idx = new Map(found.map((x, k) => [x, k])), of = Uint32Array.from(data.blocks, (b) => idx.get(b[key] ?? ""));
      return { names: found, code: (i) => of[data.block[i]], wide: 5 };
    };
    const all = [...new Set(Object.values(data.points).flat())], place = new Map(all.map((x, k) => [x, k]));
    const lists = Object.fromEntries(Object.entries(data.points).map(([target, ids]) => [target, ids.map((x) => place.get(x))])), of = data.blocks.map((b) => lists[b.target ?? ""]);
    const residual = each(Float32Array, data.n, (i) => Math.hypot(data.du[i], data.dv[i]));
    return {
      n: data.n, id: (i) => `image_point:${pointId(data, i)}`, state: (i) => (data.used[i] ? (data.w[i] > data.limit ? "suspect" : "") : "out"),
      columns: [{ key: "camera", title: t("camera"), ...coded("camera") }, { key: "epoch", title: t("kind epoch"), ...coded("epoch") }, { key: "target", title: t("target"), ...coded("target") },
        { key: "point", title: t("point"), names: all, code: (i) => of[data.block[i]][data.point[i]], wide: 5 },
        { key: "residual", title: t("residual, px"), values: residual, digits: 3, size: true, wide: 6.4 }, { key: "w", title: "w", values: data.w, digits: 2, size: true },
        ...(data.redundancy ? [{ key: "r", title: "r", values: data.redundancy, digits: 3 }] : []), { key: "used", title: t("used"), values: data.used, digits: 0, wide: 4.2, text: (i) => (data.used[i] ? "✓" : "✕") }],
      kind: "obs", sort: "w",
    };
  }

  readings() {
    const rows = this.bench.readings;
    return { n: rows.length, id: (i) => rows[i].id, state: (i) => (rows[i].used ? (rows[i].share > 1 ? "suspect" : "") : "out"), kind: "reading", sort: "w",
      columns: [named("table", t("sort of reading"), rows.map((r) => known(r.table.replaceAll("_", " ")))), named("name", t("reading"), rows.map((r) => r.name)), named("component", t("component"), rows.map((r) => known(r.component)), { wide: 5 }),
        { ...number4("observed", t("observed"), rows), wide: 7, text: (i) => (Number.isFinite(rows[i].observed) ? `${estimated({ ...rows[i], value: rows[i].observed }, 3)} ${rows[i].unit}` : "–") }, { ...number4("residual", t("residual"), rows, true), wide: 6, text: (i) => measure(rows[i].residual, rows[i].sigma_unit, 3) }, numbers("w", "w", rows.map((r) => r.w), { digits: 2, size: true }), numbers("r", "r", rows.map((r) => r.redundancy), { digits: 3 }), numbers("used", t("used"), rows.map((r) => Number(r.used)), { wide: 3.6, text: (i) => (rows[i].used ? "✓" : "✕") })] };
  }

  parameters() {
    const rows = this.bench.parameters;
    return { n: rows.length, id: (i) => rows[i].name, kind: "param", columns: [named("name", t("parameter"), rows.map((r) => r.name), { wide: 14 }), { ...number4("value", t("value"), rows), wide: 7, text: (i) => estimated(rows[i]) }, named("unit", t("unit"), rows.map((r) => r.unit ?? "")), number4("sigma", t("sigma"), rows), named("unit of sigma", t("unit"), rows.map((r) => r.sigma_unit ?? "")), named("treatment", t("treatment"), rows.map((r) => known(r.treatment ?? "")))] };
  }

  exclusions() {
    const rows = this.bench.state.exclusions;
    return { n: rows.length, id: (i) => rows[i].name, kind: "exclusion", columns: [named("what", t("what"), rows.map((r) => t(`kind ${r.what}`))), named("id", "id", rows.map((r) => r.id), { wide: 12 }), named("reason", t("reason"), rows.map((r) => r.reason), { wide: 12 }), named("author", t("who"), rows.map((r) => r.author ?? "")), named("time", t("time"), rows.map((r) => r.time ?? ""))] };
  }
}
