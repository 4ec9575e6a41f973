// The page: one set of values from the server, views that follow one selection, keys, and what may be done.

import { button, by, make } from "./dom.js";
import { known, number, significant, spoken, t } from "./words.js";
import { current, go, names, start, subscribe } from "./store.js";
import { get, live, picture, points, post, takeToken } from "./source.js";
import { changeLanguage, speak, wantedLanguage } from "./speech.js";
import { Tables } from "./tables.js";
import { askReason, previewText, tell } from "./dialogs.js";
import { keysOf } from "./keys.js";
import { drawTree, markTree } from "./tree.js";
import { drawHeader, FindingsView } from "./findings.js";
import { ImageView } from "./image.js";
import { SceneView } from "./scene.js";
import { changedShortly, CompareView, HistoryView } from "./compare.js";
import { CameraView, CorrelationsView, LoopsView, TableAnglesView } from "./relations.js";
import { NetworkView } from "./network.js";
import { JobsView } from "./jobs.js";
import { SettingsView } from "./settings.js";
import { chosenNames, drawInspector } from "./inspector.js";
import { findingsOf, leftOut, parametersOf, readingsOf, sceneOf, shiftsOf, sizesOf, stateOf } from "./shapes.js";

/** Everything the views show; new values replace old ones, nothing is changed in place. */
const bench = { state: null, points: null, limit: 1, readings: [], parameters: [], findings: {}, scene: null, sizes: {}, leftOut: new Map(), shifts: new Map(), told: {}, toldAt: 0, arrived: [], drawn: null, planned: null };
const VIEWS = {
  findings: ["Findings", () => new FindingsView(bench, actions)],
  image: ["Image", () => new ImageView(bench, picture)],
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
let lastPane = "right", busy = false;

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
    else tell(t("Done in {s} s.", { s: number((performance.now() - started) / 1000, 2) }) + changedShortly(bench.state.changes));
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

function working(text) { by("working").textContent = text; by("working").hidden = !text; }

// values and views

const tables = new Tables(bench, { show: (view, pane) => actions.show(view, pane) });

/** New values, then every view with them: observations and what is wrong first. @param {any} answer a state, or null to ask for it */
async function renew(answer) {
  const raw = answer?.state ?? (answer?.version !== undefined && answer.exclusions ? answer : await get("state"));
  const state = stateOf(raw);
  const fresh = !bench.state || bench.state.version !== state.version || bench.state.folder !== state.folder || (state.failure ?? "") !== (bench.state.failure ?? "");
  if (fresh) {
    const [columns, readings, findings] = await Promise.all([points(bench.state?.folder === state.folder ? bench.points : null), get("readings"), get("findings")]);
    Object.assign(bench, { state, points: columns, readings: readingsOf(readings), limit: readings.limit, findings: findingsOf(findings, raw), sizes: sizesOf(raw), leftOut: leftOut(columns) });
    if (!state.solved) Object.assign(bench, { parameters: [], scene: null, shifts: new Map() });
    state.changes = answer?.changes ?? (state.solved ? (await get("changes")).changes : null);
  } else Object.assign(bench, { state: { ...state, changes: bench.state?.changes } });
  drawAll(fresh);
  if (state.changed_files?.length) changedOutside(state.changed_files);
  if (fresh && state.solved) await results(state.version);
}

/** What was estimated, behind the observations. */
async function results(version) {
  const [parameters, raw] = await Promise.all([get("parameters"), get("scene")]), scene = sceneOf(raw);
  if (bench.state.version !== version) return;
  Object.assign(bench, { parameters: parametersOf(parameters), scene, shifts: shiftsOf(bench.scene, scene) });
  for (const pane of PANES) drawPane(pane);
  tables.renew("parameters");
  drawInspector(bench, actions);
  document.body.dataset.results = String(version);
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
  tables.draw(fresh);
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

// keys and the frame

function viewStep(step) {
  let view = viewOf(FindingsView);
  if (!view) { actions.show("findings", "left"); view = viewOf(FindingsView); }
  view?.step(step);
}

const nextView = (by) => { const all = Object.keys(VIEWS), at = all.indexOf(panes()[PANES.indexOf(lastPane)]); actions.show(all[(at + by + all.length) % all.length], lastPane); };
const enlarge = (by) => PANES.forEach((pane) => { const view = shown[pane]?.view; if (view instanceof ImageView) view.enlarge(by); else if (view instanceof SceneView) view.enlarge(2 ** by); });
const whole = () => PANES.forEach((pane) => shown[pane]?.view.whole?.());

const giveUp = () => { if (busy) post("cancel").catch(() => {}); else by("message").replaceChildren(); };
const KEYS = keysOf({ actions, bench, tables, image: () => viewOf(ImageView), step: viewStep, chosen: chosenNames, focus, enlarge, whole, nextView, language: () => otherLanguage(), giveUp });

function focus(region) {
  document.body.dataset.pane = region;
  drawTabs();
  if (PANES.includes(region)) lastPane = region;
  by(region).querySelector("[tabindex='0'], button, select, input")?.focus();
}

let pointed = 0;

/** The picture of what is pointed at is fetched before the click. */
function ahead(event) {
  const { image, id = "" } = event.target.closest?.("[data-image], [data-id]")?.dataset ?? {}, { what, ids } = names(id);
  const wanted = image ?? (what === "image_point" ? ids.slice(0, 2).join("/") : id);
  clearTimeout(pointed);
  if (bench.points?.imageIdx.has(wanted) && viewOf(ImageView)) pointed = setTimeout(() => picture(wanted, 1600).catch(() => {}), 40);
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
      button(spoken() === "en" ? "DE" : "EN", () => otherLanguage(), "g", { "aria-label": t("language") }), button("?", () => KEYS.at(-1)?.[2](), "?", { "aria-label": t("Keys") }));
  }
  by("undo").disabled = !state.undo.length || state.read_only;
  by("redo").disabled = !state.redo.length || state.read_only;
  by("save").disabled = state.read_only;
  by("undo").title = state.undo[0] ?? "";
  by("redo").title = state.redo[0] ?? "";
}

function drawTabs() {
  by("tabs").setAttribute("aria-label", t("Parts of the page"));
  by("tabs").replaceChildren(...REGIONS.map(([id, title]) => make("button", { type: "button", "aria-current": document.body.dataset.pane === id ? "page" : null, onclick: () => focus(id) }, t(PANES.includes(id) ? VIEWS[panes()[PANES.indexOf(id)]][0] : title))));
}

async function otherLanguage() {
  await changeLanguage();
  bench.state = null; // what the server says is said in its language too
  await renew(null);
  drawn();
}

/** Everything anew, as after a change of language. */
function drawn() {
  for (const [id, title] of REGIONS) by(id).setAttribute("aria-label", t(title));
  drawTabs();
  shown.left = shown.right = null;
  tables.forget();
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
    if (changed.has("ids")) { markTree(); drawInspector(bench, actions); tables.draw(false); }
  });
  document.addEventListener("keydown", pressed);
  document.addEventListener("pointerover", ahead);
  for (const pane of PANES) for (const name of ["pointerdown", "focusin"]) by(pane).addEventListener(name, () => { lastPane = pane; });
  addEventListener("error", (event) => tell(event.message, "bad"));
  addEventListener("unhandledrejection", (event) => tell(event.reason?.message ?? String(event.reason), "bad"));
  for (const [id, title] of REGIONS) by(id).setAttribute("aria-label", t(title));
  drawTabs();
  by("title").textContent = t("loading …");
  by("doing").append(make("output", { id: "working", class: "working", hidden: true }));
  try {
    await renew(null);
    live(told); // its cookie comes with the first answer
    if (!bench.state.solved && !bench.state.failure) working(t("adjusting …")); // a message tells when it is done
  } catch (error) { tell(error.message, "bad"); }
}

await begin();
