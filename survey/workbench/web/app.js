// The page: one set of values from the server, views that follow one selection, keys, and what may be done.

import { button, by, make } from "./dom.js";
import { known, number, significant, speak, spoken, t, wantedLanguage } from "./words.js";
import { current, go, names, select, start, subscribe } from "./store.js";
import { get, live, pointId, points, post, rowOf, takeToken } from "./source.js";
import { Table, named, numbers } from "./table.js";
import { askReason, showKeys, tell } from "./dialogs.js";
import { drawTree, markTree, placeOf } from "./tree.js";
import { drawHeader, FindingsView } from "./findings.js";
import { ImageView } from "./image.js";
import { SceneView } from "./scene.js";
import { CompareView, HistoryView } from "./compare.js";
import { CameraView, CorrelationsView, LoopsView, TableAnglesView } from "./relations.js";
import { NetworkView } from "./network.js";
import { JobsView } from "./jobs.js";
import { SettingsView } from "./settings.js";
import { chosenNames, drawInspector } from "./inspector.js";
import { findingsOf, parametersOf, readingsOf, sceneOf, shiftsOf, sizesOf, stateOf } from "./shapes.js";

/** Everything the views show; new values replace old ones, nothing is changed in place. */
const bench = { state: null, points: null, limit: 1, readings: [], parameters: [], findings: {}, scene: null, sizes: {}, leftOut: new Map(), shifts: new Map(), told: {}, toldAt: 0, arrived: [], drawn: null, planned: null };
const VIEWS = {
  findings: ["Findings", () => new FindingsView(bench, actions)],
  image: ["Image", () => new ImageView(bench)],
  scene: ["Scene", () => new SceneView(bench, "scene")],
  plan: ["Plan", () => new SceneView(bench, "plan")],
  south: ["South view", () => new SceneView(bench, "south")],
  east: ["East view", () => new SceneView(bench, "east")],
  camera: ["Camera", () => new CameraView(bench)],
  compare: ["Compare", () => new CompareView(bench)],
  history: ["History", () => new HistoryView(bench, actions)],
  angles: ["Angles", () => new TableAnglesView(bench)],
  loops: ["Loops", () => new LoopsView(bench)],
  correlations: ["Correlations", () => new CorrelationsView(bench)],
  network: ["Network", () => new NetworkView(bench)],
  jobs: ["Jobs", () => new JobsView(bench, actions)],
  settings: ["Datum", () => new SettingsView(bench, actions)],
};
const PANES = ["left", "right"];
const REGIONS = [["tree", "Project"], ["left", "First view"], ["right", "Second view"], ["tables", "Tables"], ["inspector", "Details"]];
const shown = { left: null, right: null };
const TABLES = { points: "Image points", readings: "Readings", parameters: "Parameters", exclusions: "Excluded by people" };
let followed = "", table = null, tableName = "points", lastPane = "right", asked = false, busy = false; // asked: for a table by its tab

// what may be done

const actions = {
  show(view, pane = lastPane === "left" ? "left" : "right") {
    const views = [...panes()];
    views[PANES.indexOf(pane)] = view;
    go({ view: views });
  },

  async exclude(chosen) {
    if (!chosen.length || bench.state.read_only) return;
    const changes = chosen.map((name) => ({ name, excluded: true }));
    const said = post("preview", { changes }).then((p) => ({ text: previewText(p), lost: p.epochs_lost?.length || p.images_lost?.length }));
    const reason = await askReason(chosen, said);
    if (reason) await act(() => post("exclusions", { base: bench.state.version, reason, changes }));
  },

  async include(chosen) {
    if (chosen.length && !bench.state.read_only) await act(() => post("exclusions", { base: bench.state.version, changes: chosen.map((name) => ({ name, excluded: false })) }));
  },

  /** Left out, or taken back where it is left out already. */
  toggle() {
    const chosen = chosenNames(), out = new Set(bench.state.exclusions.map((row) => row.name)), gone = chosen.filter((name) => out.has(name));
    if (!chosen.length) tell(t("Choose something first."));
    else if (gone.length) actions.include(gone);
    else actions.exclude(chosen);
  },

  image() {
    const { kind, ids } = current(), image = kind === "image" ? ids[0] : kind === "obs" ? names(ids[0]).ids.slice(0, 2).join("/") : "";
    if (image) actions.exclude([`image:${image}`]);
  },

  setting: (change) => act(() => post("definition", { base: bench.state.version, ...change })),
  remedy: (number) => act(() => post("remedy", { base: bench.state.version, number })),
  /** Another job: what it said is kept, what it drew is shown in the scene. */
  job: (name, ask) => act(async () => { const told = await ask(); bench.told[name] = told; bench.toldAt++; bench.drawn = told.drawn; if (told.drawn.scene) bench.planned = sceneOf(told.drawn.scene); return told; }, t("Done.")),
  undo: () => bench.state.undo.length && act(() => post("undo", { base: bench.state.version })),
  redo: () => bench.state.redo.length && act(() => post("redo", { base: bench.state.version })),
  adjust: (mode = "warm") => act(() => post("adjust", { base: bench.state.version, mode })),
  save: () => act(() => post("save", { base: bench.state.version }), t("Saved.")),
  reload: () => act(() => post("reload", {})),
  done: (answer) => renew(answer),
};

function previewText(p) {
  const lost = [...(p.epochs_lost ?? []).map((e) => t("epoch {id} loses its only image", { id: e })), ...(p.images_lost ?? []).slice(0, 5).map((i) => t("image {id} has no points any more", { id: i }))];
  return [t("Leaves out: {what}", { what: p.text }), ...lost].join(". ");
}

/** Something that makes a new solution; what the server refuses is said in its words. */
async function act(ask, said = "") {
  if (busy) { tell(t("Still adjusting; Esc gives it up.")); return; }
  busy = true;
  const started = performance.now();
  document.body.setAttribute("aria-busy", "true");
  working(t("adjusting …"));
  try {
    await renew(await ask());
    working("");
    by("message").replaceChildren();
    if (said) tell(said);
    else tell(t("Done in {s} s.", { s: number((performance.now() - started) / 1000, 2) }) + changedText());
  } catch (error) {
    tell(error.status === 409 ? t("Not done: {why}", { why: error.message }) : error.message, "warn");
    if (error.status === 409) await renew(null).catch(() => {});
  } finally {
    busy = false;
    working("");
    document.body.removeAttribute("aria-busy");
  }
  document.body.dataset.done = String(Math.round(performance.now() - started));
}

function changedText() {
  const changes = bench.state.changes, first = changes?.components?.[0];
  if (!first) return "";
  return ` sigma0 ${number(changes.before.sigma0, 4)} → ${number(changes.after.sigma0, 4)}; ${t("largest change")} ${first.name} ${number(first.sigmas, 2)} σ`;
}

function working(text) { by("working").textContent = text; by("working").hidden = !text; }

// values and views

/** What the server says of this solution; of a survey that cannot be adjusted its observations and what is wrong. */
const parts = (solved) => Promise.all([points(), get("readings"), solved ? get("parameters") : null, get("findings"), solved ? get("scene") : null]);

/** New values, then every view with them. @param {any} answer a state, or null to ask for it */
async function renew(answer) {
  const raw = answer?.state ?? (answer?.version !== undefined && answer.exclusions ? answer : await get("state"));
  const state = stateOf(raw);
  const fresh = !bench.state || bench.state.version !== state.version || (state.failure ?? "") !== (bench.state.failure ?? "");
  if (fresh) {
    const [columns, readings, parameters, findings, scene] = await parts(state.solved);
    const before = bench.scene;
    Object.assign(bench, { state, points: columns, readings: readingsOf(readings), limit: readings.limit, parameters: parameters ? parametersOf(parameters) : [], findings: findingsOf(findings, raw), scene: scene && sceneOf(scene), sizes: sizesOf(raw) });
    bench.shifts = scene ? shiftsOf(before, bench.scene) : new Map();
    bench.leftOut = leftOut(columns);
    state.changes = answer?.changes ?? (state.solved ? (await get("changes")).changes : null);
  } else Object.assign(bench, { state: { ...state, changes: bench.state?.changes } });
  drawAll(fresh);
  if (state.changed_files?.length) changedOutside(state.changed_files);
}

function leftOut(data) {
  const out = new Map();
  for (let k = 0; k < data.images.length; k++) {
    let n = 0;
    for (let j = data.first[k]; j < data.first[k + 1]; j++) n += 1 - data.used[data.rows[j]];
    if (n) out.set(data.images[k], n);
  }
  return out;
}

function changedOutside(files) {
  by("message").replaceChildren(make("span", { class: "warn" }, t("{files} changed outside this page.", { files: files.join(", ") })), button(t("Load again"), () => actions.reload()));
}

function drawAll(fresh) {
  drawHeader(bench.state);
  drawDoing();
  if (!bench.points) return;
  document.body.dataset.ready ??= String(Math.round(performance.now()));
  if (fresh) drawTree(bench);
  for (const pane of PANES) drawPane(pane);
  drawTable(fresh);
  drawInspector(bench, actions);
}

/** Views of the two panes: from the address, else findings beside an image (without images the scene), a run in the history. */
function panes() {
  const first = ["findings", current().run ? "history" : bench.points?.images.length ? "image" : "scene"];
  return PANES.map((_, k) => (VIEWS[current().view[k]] ? current().view[k] : first[k]));
}

function drawPane(pane) {
  const name = panes()[PANES.indexOf(pane)];
  if (shown[pane]?.name === name) { shown[pane].view.follow(); return; }
  drawTabs();
  const chooser = make("select", { "aria-label": t("view"), onchange: () => actions.show(chooser.value, pane) }, ...Object.entries(VIEWS).map(([id, [title]]) => make("option", { value: id, selected: id === name }, t(title))));
  shown[pane] = { name, view: VIEWS[name][1]() };
  by(pane).replaceChildren(make("div", { class: "chooser" }, chooser), shown[pane].view.element);
  by(pane).setAttribute("aria-label", t(VIEWS[name][0]));
}

function viewOf(type) { return PANES.map((pane) => shown[pane]?.view).find((view) => view instanceof type); }

// the table below

function tableData() {
  const data = bench.points;
  if (tableName === "points") {
    const name = (key) => ({ names: [...new Set(data.blocks.map((b) => b[key] ?? ""))] });
    const code = (key, found) => { const idx = new Map(found.names.map((x, k) => [x, k])), of = data.blocks.map((b) => idx.get(b[key] ?? "")); return Uint32Array.from(data.block, (b) => of[b]); };
    const column = (key, title) => { const found = name(key); return { key, title, names: found.names, codes: code(key, found), wide: 5 }; };
    const all = [...new Set(Object.values(data.points).flat())], place = new Map(all.map((x, k) => [x, k]));
    const lists = data.blocks.map((b) => data.points[b.target ?? ""].map((x) => place.get(x)));
    const residual = Float32Array.from(data.du, (du, i) => Math.hypot(du, data.dv[i]));
    return {
      n: data.n, id: (i) => `image_point:${pointId(data, i)}`, state: (i) => (data.used[i] ? (data.w[i] > data.limit ? "suspect" : "") : "out"),
      columns: [column("camera", t("camera")), column("epoch", t("kind epoch")), column("target", t("target")),
        { key: "point", title: t("point"), names: all, codes: Uint32Array.from(data.point, (p, i) => lists[data.block[i]][p]), wide: 5 },
        { key: "residual", title: t("residual, px"), values: residual, digits: 3, size: true }, { key: "w", title: "w", values: data.w, digits: 2, size: true },
        ...(data.redundancy ? [{ key: "r", title: "r", values: data.redundancy, digits: 3 }] : []), { key: "used", title: t("used"), values: data.used, digits: 0, text: (i) => (data.used[i] ? "✓" : "✕") }],
      kind: "obs", sort: "w",
    };
  }
  if (tableName === "readings") {
    const rows = bench.readings;
    return { n: rows.length, id: (i) => rows[i].id, state: (i) => (rows[i].used ? (rows[i].share > 1 ? "suspect" : "") : "out"), kind: "reading", sort: "w",
      columns: [named("table", t("sort of reading"), rows.map((r) => known(r.table.replaceAll("_", " ")))), named("name", t("reading"), rows.map((r) => r.name)), named("component", t("component"), rows.map((r) => r.component)),
        number4("observed", t("observed"), rows), number4("residual", t("residual"), rows, true), named("unit", t("unit"), rows.map((r) => r.sigma_unit ?? "")), numbers("w", "w", rows.map((r) => r.w), { digits: 2, size: true }), numbers("r", "r", rows.map((r) => r.redundancy), { digits: 3 }), numbers("used", t("used"), rows.map((r) => Number(r.used)), { text: (i) => (rows[i].used ? "✓" : "✕") })] };
  }
  if (tableName === "parameters") {
    const rows = bench.parameters;
    return { n: rows.length, id: (i) => rows[i].name, kind: "param", columns: [named("name", t("parameter"), rows.map((r) => r.name), { wide: 14 }), number4("value", t("value"), rows), named("unit", t("unit"), rows.map((r) => r.unit ?? "")), number4("sigma", t("sigma"), rows), named("unit of sigma", t("unit"), rows.map((r) => r.sigma_unit ?? "")), named("treatment", t("treatment"), rows.map((r) => known(r.treatment ?? "")))] };
  }
  const rows = bench.state.exclusions;
  return { n: rows.length, id: (i) => rows[i].name, kind: "exclusion", columns: [named("what", t("what"), rows.map((r) => t(`kind ${r.what}`))), named("id", "id", rows.map((r) => r.id), { wide: 12 }), named("reason", t("reason"), rows.map((r) => r.reason), { wide: 12 }), named("author", t("who"), rows.map((r) => r.author ?? "")), named("time", t("time"), rows.map((r) => r.time ?? ""))] };
}

const number4 = (key, title, rows, size = false) => numbers(key, title, rows.map((r) => r[key]), { size, text: (i) => significant(rows[i][key], 6) });

/** Tables in which a chosen thing is found. */
const TABLE_OF = { obs: "points", reading: "readings", param: "parameters" };

function drawTable(fresh) {
  const wanted = TABLE_OF[current().kind];
  if (wanted && wanted !== tableName && followed !== current().ids[0]) { tableName = wanted; table = null; }
  followed = current().ids[0];
  const first = bench.points.n ? "points" : "readings";
  if (!asked && fresh && tableName !== first) { tableName = first; table = null; }
  if (!table) {
    const data = tableData();
    table = new Table(t(TABLES[tableName]), data, { sort: data.sort, onselect: (rows, quiet) => selectRows(data.kind, rows, quiet), onenter: (row) => { selectRows(data.kind, [row], false); actions.show("image", "right"); } });
    const tab = (name, title) => make("button", { type: "button", role: "tab", "aria-selected": name === tableName, onclick: () => { asked = true; tableName = name; table = null; drawTable(false); } }, t(title));
    by("tables").replaceChildren(make("div", { role: "tablist", "aria-label": t("Tables"), class: "tabs" }, ...Object.entries(TABLES).map(([name, title]) => tab(name, title))), table.element);
  } else if (fresh) table.renew(tableData());
  const { kind, ids } = current();
  if (tableName === "points" && kind === "obs") table.mark(ids, ids[0]?.startsWith("image_point:") ? rowOf(bench.points, names(ids[0]).ids) : -1);
  else if (tableName === "readings" && kind === "reading") table.mark(ids, bench.readings.findIndex((r) => r.id === ids[0]));
  else if (tableName === "parameters" && kind === "param") table.mark(ids, bench.parameters.findIndex((r) => r.name === ids[0]));
  else table.mark([]);
}

function selectRows(kind, rows, quiet) {
  if (!rows.length) return;
  if (kind === "exclusion") { const row = bench.state.exclusions[rows[0]]; select(...placeOf(row.what, row.id), quiet); } else select(kind, rows.slice(0, 1000).map((i) => table.data.id(i)), quiet);
}

// keys and the frame

/** Key, what it says under "?", and what it does. */
const KEYS = [
  ["j", "next suspect", () => viewStep(1)], ["k", "previous suspect", () => viewStep(-1)],
  ["]", "next image", () => viewOf(ImageView)?.next(1)], ["[", "previous image", () => viewOf(ImageView)?.next(-1)],
  ["}", "next image of this epoch", () => viewOf(ImageView)?.next(1, true)], ["{", "previous image of this epoch", () => viewOf(ImageView)?.next(-1, true)],
  ["Enter", "show the image", () => actions.show("image", "right")],
  ["x", "leave out what is chosen (or take it back)", () => actions.toggle()], ["X", "leave out the whole image", () => actions.image()], ["e", "take back what is chosen", () => actions.include(chosenNames())],
  ["m", "carry out the first remedy", () => { if (bench.findings.remedies?.[0]?.possible && !bench.state.read_only) actions.remedy(1); }],
  ["a", "adjust again", () => actions.adjust("warm")], ["A", "adjust from the beginning", () => actions.adjust("cold")],
  ["u", "undo (also Ctrl-Z)", () => actions.undo()], ["U", "redo (also Ctrl-Shift-Z)", () => actions.redo()], ["s", "save (also Ctrl-S)", () => actions.save()],
  ["f", "filter the table", () => { table?.field.focus(); table?.field.select(); }],
  ["1", "project", () => focus("tree")], ["2", "first view", () => focus("left")], ["3", "second view", () => focus("right")], ["4", "tables", () => focus("tables")], ["5", "details", () => focus("inspector")],
  ["+", "longer vectors, larger ellipsoids", () => enlarge(1)], ["-", "shorter vectors, smaller ellipsoids", () => enlarge(-1)],
  ["0", "the whole image or scene", () => whole()], ["o", "overlay on or off", () => { const view = viewOf(ImageView); if (view) { view.overlay = !view.overlay; view.surface.redraw(); } }],
  ["d", "before and after", () => actions.show("compare", "left")], ["v", "next view in this pane", () => nextView(1)], ["V", "previous view in this pane", () => nextView(-1)],
  ["g", "language", () => changeLanguage()], ["Escape", "give up what is being adjusted", () => { if (busy) post("cancel").catch(() => {}); else by("message").replaceChildren(); }], ["?", "these keys", () => showKeys(KEYS.map(([key, does]) => [key, t(`key ${does}`)]))],
];

function viewStep(step) {
  let view = viewOf(FindingsView);
  if (!view) { actions.show("findings", "left"); view = viewOf(FindingsView); }
  view?.step(step);
}

const nextView = (by) => { const all = Object.keys(VIEWS), at = all.indexOf(panes()[PANES.indexOf(lastPane)]); actions.show(all[(at + by + all.length) % all.length], lastPane); };
const enlarge = (by) => PANES.forEach((pane) => { const view = shown[pane]?.view; if (view instanceof ImageView) view.enlarge(by); else if (view instanceof SceneView) view.enlarge(2 ** by); });
const whole = () => PANES.forEach((pane) => { const view = shown[pane]?.view; if (view instanceof ImageView) view.fit = true; else if (view instanceof SceneView) Object.assign(view, { zoom: 1, dx: 0, dy: 0 }); else return; view.surface.redraw(); });

function focus(region) {
  document.body.dataset.pane = region;
  drawTabs();
  if (PANES.includes(region)) lastPane = region;
  by(region).querySelector("[tabindex='0'], button, select, input")?.focus();
}

function pressed(event) {
  if (event.target.closest("input, textarea, select, dialog") || event.altKey) return;
  const command = event.ctrlKey || event.metaKey, lower = event.key.toLowerCase();
  let key = event.key;
  if (command) {
    if (lower === "z") key = event.shiftKey ? "U" : "u";
    else if (lower === "s") key = "s";
    else return;
  }
  if (key === "Enter" && event.target.closest("button, a, summary, [role=grid]")) return;
  const found = KEYS.find((row) => row[0] === key);
  if (!found || !bench.points) return;
  event.preventDefault();
  found[2]();
}

function drawDoing() {
  const { state } = bench;
  const first = by("doing").childElementCount === 0 || by("doing").dataset.language !== spoken();
  if (first) {
    by("doing").dataset.language = spoken();
    by("doing").setAttribute("aria-label", t("Actions"));
    by("doing").replaceChildren(make("output", { id: "working", class: "working", hidden: true }), button(t("Adjust"), () => actions.adjust("warm"), "a", { id: "adjust" }), button(t("Undo"), () => actions.undo(), "u", { id: "undo" }), button(t("Redo"), () => actions.redo(), "U", { id: "redo" }), button(t("Save"), () => actions.save(), "s", { id: "save", class: "primary" }),
      button(spoken() === "en" ? "DE" : "EN", () => changeLanguage(), "g", { "aria-label": t("language") }), button("?", () => KEYS.at(-1)?.[2](), "?", { "aria-label": t("Keys") }));
  }
  by("undo").disabled = !state.undo.length || state.read_only;
  by("redo").disabled = !state.redo.length || state.read_only;
  by("save").disabled = by("adjust").disabled = state.read_only;
  by("undo").title = state.undo[0] ?? "";
  by("redo").title = state.redo[0] ?? "";
}

function drawTabs() {
  by("tabs").setAttribute("aria-label", t("Parts of the page"));
  by("tabs").replaceChildren(...REGIONS.map(([id, title]) => make("button", { type: "button", "aria-current": document.body.dataset.pane === id ? "page" : null, onclick: () => focus(id) }, t(PANES.includes(id) ? VIEWS[panes()[PANES.indexOf(id)]][0] : title))));
}

async function changeLanguage() {
  const to = spoken() === "en" ? "de" : "en";
  localStorage.setItem("language", to);
  await speak(to);
  bench.state = null; // what the server says is said in its language too
  await renew(null);
  drawn();
}

/** Everything anew, as after a change of language. */
function drawn() {
  for (const [id, title] of REGIONS) by(id).setAttribute("aria-label", t(title));
  drawTabs();
  shown.left = shown.right = table = null;
  by("tree").replaceChildren();
  drawAll(true);
}

function told(message) {
  if (message.type === "progress") working(t("step {n}, v'Pv {omega}", { n: message.step ?? message.iteration ?? 0, omega: significant(message.omega, 5) }));
  else if (message.type === "state" && !busy && bench.state) { working(""); renew(null); }
  else if (message.type === "error") { working(""); renew(null); }
  else if (message.type === "detected") { bench.arrived.push(message); viewOf(JobsView)?.arrive(message); working(t("detecting {image}", { image: message.image })); }
  else if (message.type === "folder" && message.changed?.length && !busy) changedOutside(message.changed);
  else if (message.type === "lost") document.body.classList.add("lost");
  else if (message.type === "connected") { document.body.classList.remove("lost"); if (!bench.state?.solved) renew(null); }
}

async function begin() {
  takeToken();
  await speak(wantedLanguage());
  start();
  subscribe((changed) => {
    if (!bench.points) return;
    for (const pane of PANES) drawPane(pane);
    if (changed.has("ids")) { markTree(); drawInspector(bench, actions); drawTable(false); }
  });
  document.addEventListener("keydown", pressed);
  for (const pane of PANES) for (const name of ["pointerdown", "focusin"]) by(pane).addEventListener(name, () => { lastPane = pane; });
  addEventListener("error", (event) => tell(event.message, "bad"));
  addEventListener("unhandledrejection", (event) => tell(event.reason?.message ?? String(event.reason), "bad"));
  drawn0();
  try {
    await renew(null);
    live(told); // its cookie comes with the first answer
    if (!bench.state.solved && !bench.state.failure) working(t("adjusting …")); // a message tells when it is done
  } catch (error) { tell(error.message, "bad"); }
}

function drawn0() { drawTabs(); for (const [id, title] of REGIONS) by(id).setAttribute("aria-label", t(title)); by("title").textContent = t("loading …"); by("doing").append(make("output", { id: "working", class: "working", hidden: true })); }

await begin();
