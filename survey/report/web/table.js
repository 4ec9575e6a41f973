// A table of any length: only the rows in sight are in the page; sorted, filtered, chosen by mouse or keys, copied as CSV.

import { make } from "./dom.js";
import { count, number, t } from "./words.js";
import { chosen, codeOf, conditions, orderOf, ranks } from "./order.js";

const ROW = 24;
const MOST = 30e6; // px: taller than this no browser draws

const NARROW = 700; // px of a screen on which not all columns are in sight

/** What the rows are sorted by behind the name they begin with. */
function foremost(data, key) {
  const of = data.columns.find((c) => c.key === key), [first, ...others] = data.columns.filter((c) => c !== of);
  return of ? { ...data, columns: [first, of, ...others] } : data;
}

export class Table {
  /**
   * @param {string} label
   * @param {{n: number, columns: import("./order.js").Column[], id: (i: number) => string, state?: (i: number) => string}} data
   * @param {{onselect: (rows: number[], quiet: boolean) => void, onenter?: (row: number) => void, sort?: string}} how
   */
  constructor(label, data, how) {
    this.data = how.sort && innerWidth < NARROW ? foremost(data, how.sort) : data;
    this.how = how;
    this.sorted = null;
    this.selected = new Set();
    this.at = -1; // place in `shown` of the row with the focus
    this.field = make("input", { type: "search", placeholder: t("filter: words, w>3"), "aria-label": t("filter: words, w>3"), oninput: () => this.filter() });
    this.where = make("output", { class: "quiet" });
    this.head = make("div", { role: "row", class: "row head", "aria-rowindex": 1 });
    this.tall = make("div", { class: "tall" });
    this.rows = make("div", { class: "rows", role: "rowgroup" });
    this.scroll = make("div", { class: "scroll", tabindex: 0, role: "grid", "aria-label": label, "aria-multiselectable": "true", onscroll: () => this.soon(), onkeydown: (event) => this.key(event) },
      this.head, make("div", { class: "body", role: "presentation" }, this.tall, this.rows));
    this.element = make("div", { class: "table" }, make("div", { class: "bar" }, this.field, this.where), this.scroll);
    this.rows.addEventListener("click", (event) => this.click(event));
    this.rows.addEventListener("dblclick", () => this.how.onenter?.(this.shown[this.at]));
    new ResizeObserver(() => this.draw()).observe(this.scroll);
    this.heads();
    this.order = Uint32Array.from({ length: data.n }, (_, i) => i);
    const first = how.sort && this.data.columns.findIndex((c) => c.key === how.sort);
    if (first !== undefined && first !== "" && first >= 0) this.sort(first, false);
    else this.filter();
  }

  /** The same table with new values: order, filter and place stay. */
  renew(data) {
    this.data = this.how.sort && innerWidth < NARROW ? foremost(data, this.how.sort) : data;
    if (this.sorted) this.sort(this.sorted.column, this.sorted.up);
    else { this.order = Uint32Array.from({ length: data.n }, (_, i) => i); this.filter(); }
  }

  heads() {
    const widths = this.data.columns.map((c) => c.wide ?? (c.values ? 4.6 : 6));
    this.scroll.style.setProperty("--columns", widths.map((rem) => `minmax(0, ${rem}fr)`).join(" "));
    this.scroll.style.setProperty("--width", `${widths.reduce((sum, rem) => sum + rem + 0.6, 1)}rem`);
    this.head.replaceChildren(...this.data.columns.map((column, k) => {
      const head = make("button", { type: "button", tabindex: -1, class: column.values ? "r" : "l", "aria-label": column.title ? null : column.label, onclick: () => this.sort(k, this.sorted?.column === k ? !this.sorted.up : !this.data.columns[k].size) }, column.title);
      return make("span", { role: "columnheader", "aria-colindex": k + 1 }, head);
    }));
  }

  /** @param {number} k @param {boolean} up */
  sort(k, up) {
    const column = this.data.columns[k];
    this.sorted = { column: k, up };
    if (column.values) this.order = orderOf(column.values, up, column.size);
    else {
      const rank = ranks(column.names ?? []), code = codeOf(column), places = new Float32Array(this.data.n);
      for (let i = 0; i < places.length; i++) places[i] = rank[code(i)];
      this.order = orderOf(places, up);
    }
    [...this.head.children].forEach((head, j) => (j === k ? head.setAttribute("aria-sort", up ? "ascending" : "descending") : head.removeAttribute("aria-sort")));
    this.filter();
  }

  filter() {
    this.shown = chosen(this.order, conditions(this.field.value, this.data.columns));
    this.scroll.setAttribute("aria-rowcount", String(this.shown.length + 1));
    this.height = Math.min(ROW * this.shown.length, MOST);
    this.tall.style.height = `${this.height}px`;
    this.where.textContent = this.shown.length === this.data.n ? t("{n} rows", { n: count(this.data.n) }) : t("{k} of {n} rows", { k: count(this.shown.length), n: count(this.data.n) });
    this.draw();
  }

  soon() { if (!this.waiting) { this.waiting = true; requestAnimationFrame(() => { this.waiting = false; this.draw(); }); } }

  draw() {
    const room = this.scroll.clientHeight, n = this.shown.length;
    if (!room) return;
    const fits = Math.max(1, Math.floor((room - ROW) / ROW));
    // very long tables: the place of the bar is a share of the rows, not a pixel of one
    const share = ROW * n > MOST ? this.scroll.scrollTop / Math.max(1, this.height - room + ROW) * (n - fits) : this.scroll.scrollTop / ROW;
    const from = Math.max(0, Math.min(Math.floor(share), n - 1)), to = Math.min(n, from + fits + 2);
    this.from = from;
    this.rows.style.transform = `translateY(${ROW * n > MOST ? this.scroll.scrollTop : from * ROW}px)`;
    const rows = [];
    for (let place = from; place < to; place++) rows.push(this.row(place));
    this.rows.replaceChildren(...rows);
  }

  row(place) {
    const i = this.shown[place], state = this.data.state?.(i) ?? "";
    const row = make("div", { role: "row", class: `row ${state}`, "aria-rowindex": place + 2, "aria-selected": this.selected.has(this.data.id(i)), data: { place, id: this.data.id(i) } });
    for (const column of this.data.columns) {
      row.append(make("span", { role: "gridcell", class: column.values ? "r" : "l" }, this.text(column, i)));
    }
    return row;
  }

  text(column, i) {
    if (column.text) return column.text(i);
    return column.values ? number(column.values[i], column.digits ?? 3) : column.names[codeOf(column)(i)];
  }

  /** Shows what is chosen elsewhere; scrolls to the first. @param {string[]} ids @param {number} [row] */
  mark(ids, row = -1) {
    this.selected = new Set(ids);
    if (row >= 0) {
      const place = this.shown.indexOf(row);
      if (place >= 0) { this.at = place; this.reveal(place); }
    }
    this.draw();
  }

  reveal(place) {
    const fits = Math.max(1, Math.floor((this.scroll.clientHeight - ROW) / ROW));
    if (place >= this.from && place < this.from + fits) return;
    const first = Math.max(0, place - Math.floor(fits / 2));
    this.scroll.scrollTop = ROW * this.shown.length > MOST ? first / Math.max(1, this.shown.length - fits) * (this.height - this.scroll.clientHeight) : first * ROW;
  }

  click(event) {
    const row = event.target.closest(".row");
    if (!row) return;
    this.choose(Number(row.dataset.place), event.shiftKey, event.ctrlKey || event.metaKey);
  }

  choose(place, extend = false, toggle = false, quiet = false) {
    const id = this.data.id(this.shown[place]);
    if (extend && this.at >= 0) {
      const [a, b] = [Math.min(this.at, place), Math.max(this.at, place)];
      for (let k = a; k <= b && k < a + 1000; k++) this.selected.add(this.data.id(this.shown[k]));
    } else if (toggle) this.selected.has(id) ? this.selected.delete(id) : this.selected.add(id);
    else this.selected = new Set([id]);
    this.at = place;
    const rows = [this.shown[place]];
    if (this.selected.size > 1 || !this.selected.has(id)) for (const i of this.shown) if (i !== rows[0] && this.selected.has(this.data.id(i))) rows.push(i);
    this.how.onselect(this.selected.has(id) ? rows : rows.slice(1), quiet);
    this.reveal(place);
    this.draw();
  }

  /** The next or previous row becomes the one looked at. @param {number} by @param {boolean} [extend] */
  step(by, extend = false) {
    const place = Math.max(0, Math.min(this.shown.length - 1, this.at + by));
    if (this.shown.length) this.choose(place, extend, false, true);
  }

  key(event) {
    const page = Math.max(1, Math.floor(this.scroll.clientHeight / ROW) - 2);
    const by = { ArrowDown: 1, ArrowUp: -1, PageDown: page, PageUp: -page, Home: -1e9, End: 1e9 }[event.key];
    if (by) { event.preventDefault(); event.stopPropagation(); this.step(by, event.shiftKey); }
    else if (event.key === "Enter" && this.at >= 0) this.how.onenter?.(this.shown[this.at]);
    else if (event.key === "c" && (event.ctrlKey || event.metaKey)) { event.preventDefault(); navigator.clipboard?.writeText(this.csv()); }
  }

  /** The chosen rows (all shown ones where none is) as CSV; what a spreadsheet would take for a formula is quoted as text. */
  csv() {
    const quote = (text) => {
      const safe = /^[=+@\t]|^-(?![\d.])/.test(text) ? `'${text}` : text;
      return /[",\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
    };
    const rows = [...this.shown].filter((i) => !this.selected.size || this.selected.has(this.data.id(i))).slice(0, 100000);
    const cell = (column, i) => (column.values ? (Number.isFinite(column.values[i]) ? String(column.values[i]) : "") : column.text ? column.text(i) : column.names[codeOf(column)(i)]);
    return [this.data.columns.map((c) => quote(c.title)).join(","), ...rows.map((i) => this.data.columns.map((c) => quote(cell(c, i))).join(","))].join("\n") + "\n";
  }
}

/** Names as a column: one entry for each different one. @param {string} key @param {string} title @param {string[]} values */
export function named(key, title, values, extra = {}) {
  const idx = new Map();
  const codes = Uint32Array.from(values, (value) => { if (!idx.has(value)) idx.set(value, idx.size); return idx.get(value); });
  return { key, title, names: [...idx.keys()], codes, ...extra };
}

/** Numbers as a column. @param {string} key @param {string} title @param {(number|null)[]} values */
export const numbers = (key, title, values, extra = {}) => ({ key, title, values: Float64Array.from(values, (value) => value ?? NaN), ...extra });
