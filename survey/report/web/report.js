// The report on a screen: its tables sorted and filtered, all observations, the survey in space, and places followed.
// Without this script the page shows the same numbers, the worst observations first.

import { make } from "./dom.js";
import { t, use } from "./words.js";
import { current, select, start, subscribe } from "./store.js";
import { Table } from "./table.js";
import { SceneView } from "./scene.js";
import { sceneOf } from "./shapes.js";

const LONG = 14; // rows from which on a table gets a field to filter it

const data = (id) => JSON.parse(document.getElementById(id)?.textContent ?? "null");
const words = data("words");

/** What a cell says as a number, NaN for none. @param {string} text */
function number(text) {
  const clean = text.replace(/[\u2009\s]/g, "").replace("−", "-").replace(words.decimal, ".");
  return parseFloat(clean.match(/^[<±]?(-?\d+(\.\d+)?(e-?\d+)?)/)?.[1] ?? "");
}

function compare(a, b) {
  if (typeof a !== "number" || typeof b !== "number") return String(a).localeCompare(String(b), undefined, { numeric: true });
  return Number.isNaN(a) ? Number(!Number.isNaN(b)) : Number.isNaN(b) ? -1 : a - b;
}

/** A small table: its own rows are moved and hidden. @param {HTMLTableElement} table */
function small(table) {
  const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, k) => {
    if (!head.textContent) return;
    const key = (row) => { const text = row.cells[k].firstChild?.textContent ?? ""; return head.classList.contains("r") ? number(text) : text; };
    const sort = () => {
      const up = head.getAttribute("aria-sort") !== "ascending";
      body.append(...[...body.rows].map((row) => [key(row), row]).sort((a, b) => (up ? 1 : -1) * compare(a[0], b[0])).map(([, row]) => row));
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
    };
    head.classList.add("sorts");
    head.tabIndex = 0;
    head.addEventListener("click", sort);
    head.addEventListener("keydown", (event) => { if (event.key === "Enter") sort(); });
  });
  if (body.rows.length <= LONG) return;
  const field = make("input", { type: "search", class: "filter screen", placeholder: t("filter"), "aria-label": t("filter"), oninput: () => {
    const wanted = field.value.toLowerCase();
    for (const row of body.rows) row.hidden = !row.textContent.toLowerCase().includes(wanted);
  } });
  table.parentNode.before(field);
}

/** All observations, one row per component; the places of the workbench lead to them. */
function everyObservation(found) {
  const names = (column, i) => column.names[column.codes[i]], [where, point] = found.at.map((k) => found.columns[k]);
  const place = (i) => {
    const reading = names(found.places, i);
    if (reading) return ["reading", reading];
    const image = names(where, i).split(" · ").filter((x, k) => k < 2 || x !== "points");
    return ["obs", `image_point:${[...image, names(point, i)].join("/")}`];
  };
  const text = (column) => (i) => (column.values[i] === null ? "–" : String(column.values[i]).replace("-", "−").replace(".", words.decimal));
  const columns = found.columns.map((c) => ({ ...c, wide: Math.max({ Where: 9, Point: 5, Residual: 6, Group: 8, Kind: 7 }[c.key] ?? 4.6, 0.5 * c.title.length + 1.2), ...(c.values ? { values: Float64Array.from(c.values, (x) => x ?? NaN), text: text(c) } : {}) }));
  columns.splice(3, 0, { key: "state", title: "", label: words.flags.filter(Boolean).join(", "), names: words.flags, codes: found.flags, wide: 7 });
  const rows = { n: found.rows, id: (i) => place(i)[1], state: (i) => ["", "suspect", "out"][found.flags[i]], columns };
  const table = new Table(t("All observations"), rows, { sort: "w", onselect: (chosen, quiet) => select(place(chosen[0])[0], [...new Set(chosen.map((i) => place(i)[1]))], quiet) });
  document.getElementById("all").append(table.element);
  return {
    element: table.element,
    /** Shows a place; whether there is one. */
    show(kind, ids) {
      if (kind === "image") { table.field.value = ids[0].replace("/", " "); table.filter(); table.mark([]); return true; }
      const at = kind === "obs" || kind === "reading" ? table.order.findIndex((i) => { const [k, id] = place(i); return k === kind && id === ids[0]; }) : -1;
      if (at >= 0 && !table.shown.includes(table.order[at])) { table.field.value = ""; table.filter(); }
      table.mark(at < 0 ? [] : ids, at < 0 ? -1 : table.order[at]);
      return at >= 0;
    },
  };
}

/** The survey in space. */
function space(found) {
  const view = new SceneView({ scene: sceneOf(found), points: null, region: found.ellipsoid }, "scene", true);
  view.factor = found.enlarged;
  document.getElementById("space").append(view.element);
  return view;
}

/** The row of a thing in one of the tables that are always there, or the heading of what is said of it. @param {string} id */
const rowOf = (id) => [...document.querySelectorAll("main tbody tr")].find((row) => row.cells[0]?.textContent.trim() === id) ?? [...document.querySelectorAll("main h3")].find((head) => head.textContent.split(", ")[0] === id);

function begin() {
  use(words.language, words.texts);
  document.documentElement.classList.add("ready"); // first: what is drawn needs its place on the page
  for (const table of document.querySelectorAll("table")) if (table.tHead && table.tBodies[0].rows.length > 1) small(table);
  const observations = data("all-data"), drawn = data("space-data");
  const all = observations && everyObservation(observations), view = drawn && space(drawn);
  const follow = (scrolling) => {
    const { kind, ids } = current();
    for (const old of document.querySelectorAll("main .here")) old.classList.remove("here");
    view?.follow();
    if (!kind) return;
    const listed = all?.show(kind, ids), row = listed ? null : rowOf(ids[0]) ?? rowOf(ids[0].split("/").pop());
    row?.classList.add("here");
    if (scrolling) (row ?? (listed ? all.element : null))?.scrollIntoView({ block: "center" });
  };
  start();
  subscribe((changed) => follow(changed.has("run"))); // an address names a whole place; what is clicked is in sight
  follow(true);
}

begin();
