// The page: values come from the server, views follow one selection, keys and messages arrive here.

import { button, by, make } from "./dom.js";
import { significant, t } from "./words.js";
import { names, start, subscribe } from "./store.js";
import { live, picture, takeToken } from "./source.js";
import { changeLanguage, speak, wantedLanguage } from "./speech.js";
import { bench, load, loadResults } from "./bench.js";
import * as frame from "./frame.js";
import { actionsOf } from "./actions.js";
import { Tables } from "./tables.js";
import { tell } from "./dialogs.js";
import { keyOf, keysOf } from "./keys.js";
import { drawTree, markTree } from "./tree.js";
import { drawHeader, working } from "./header.js";
import { drawInspector } from "./inspector.js";
import { FindingsView } from "./findings.js";
import { ImageView } from "./image.js";
import { SceneView } from "./scene.js";
import { CompareView, HistoryView } from "./compare.js";
import { CameraView, CorrelationsView, HalvesView, LoopsView, TableAnglesView } from "./relations.js";
import { NetworkView } from "./network.js";
import { JobsView } from "./jobs.js";
import { CaptureView } from "./capture.js";
import { SettingsView } from "./settings.js";
import { drawBeginning } from "./beginning.js";

const actions = actionsOf(renew, () => changedOutside());
const tables = new Tables(bench, { show: frame.show });
const VIEWS = {
  findings: ["Findings", () => new FindingsView(bench, actions)],
  image: ["Image", () => new ImageView(bench, picture)],
  scene: ["Scene", () => new SceneView(bench, "scene")],
  plan: ["Plan", () => new SceneView(bench, "plan")],
  south: ["South view", () => new SceneView(bench, "south")],
  east: ["East view", () => new SceneView(bench, "east")],
  camera: ["Camera", () => new CameraView(bench)],
  halves: ["Cross-validation", () => new HalvesView(bench)],
  compare: ["Compare", () => new CompareView(bench)],
  history: ["History", () => new HistoryView(bench, actions)],
  angles: ["Angles", () => new TableAnglesView(bench)],
  loops: ["Loops", () => new LoopsView(bench)],
  correlations: ["Correlations", () => new CorrelationsView(bench)],
  network: ["Network", () => new NetworkView(bench)],
  jobs: ["Jobs", () => new JobsView(bench, actions)],
  capture: ["Capture", () => new CaptureView()],
  settings: ["Datum", () => new SettingsView(bench, actions)],
};
const page = {
  actions, bench, tables, frame, language: otherLanguage,
  image: () => frame.viewOf(ImageView),
  /** The next or previous suspect. @param {number} by */
  step(by) {
    if (!frame.viewOf(FindingsView)) frame.show("findings", "left");
    frame.viewOf(FindingsView)?.step(by);
  },
  /** Vectors of an image, ellipsoids of a scene. @param {number} by */
  enlarge: (by) => frame.eachView((view) => { if (view instanceof ImageView) view.enlarge(by); else if (view instanceof SceneView) view.enlarge(2 ** by); }),
};
const KEYS = keysOf(page);

let last = Promise.resolve();

/** One after the other: what was asked for first must not be shown over what came of something newer. @param {any} answer see `load` */
function renew(answer, anew = false) {
  const next = last.then(() => shown(answer, anew));
  last = next.catch(() => {});
  return next;
}

/** New values, then every view with them: observations and what is wrong first. */
async function shown(answer, anew) {
  const fresh = await load(answer, anew);
  document.body.classList.toggle("beginning", Boolean(bench.beginning));
  if (bench.beginning) { drawBeginning(bench.beginning, actions); return; }
  drawAll(fresh);
  changedOutside(bench.state.changed_files ?? []);
  if (!fresh || !bench.state.solved || !(await loadResults())) return;
  frame.drawPanes();
  tables.renew("parameters");
  drawInspector(bench, actions);
  document.body.dataset.results = String(bench.state.version);
}

function drawAll(fresh) {
  drawHeader(bench.state, actions, { keys: () => keyOf(KEYS, "?")(), language: otherLanguage });
  if (!bench.points) return;
  document.body.dataset.ready ??= String(Math.round(performance.now()));
  if (fresh) drawTree(bench);
  frame.drawPanes();
  tables.draw(fresh);
  drawInspector(bench, actions);
}

/** Said where nothing runs, for what runs may end it; unsaid when it holds no more. */
function changedOutside(files = bench.state?.changed_files ?? []) {
  if (bench.state) bench.state.changed_files = files;
  const said = by("message").querySelector(".outside");
  if (files.length && !actions.busy) by("message").replaceChildren(make("span", { class: "warn outside" }, t("{files} changed outside this page.", { files: files.join(", ") })), button(t("Load again"), () => actions.reload()));
  else if (!files.length && said) by("message").replaceChildren();
}

/** Others made the state that the server has now. */
const isNew = ({ version, unsaved }) => version !== bench.state.version || unsaved !== bench.state.unsaved;

async function otherLanguage() {
  await changeLanguage();
  frame.forget();
  tables.forget();
  by("tree").replaceChildren();
  await renew(null, true); // what the server says is said in its language too
}

let pointed = 0;

/** The picture of what is pointed at is fetched before the click. */
function ahead(event) {
  const { image, id = "" } = event.target.closest?.("[data-image], [data-id]")?.dataset ?? {}, { what, ids } = names(id);
  const wanted = image ?? (what === "image_point" ? ids.slice(0, 2).join("/") : id);
  clearTimeout(pointed);
  if (bench.pictured && bench.points?.imageIdx.has(wanted) && page.image()) pointed = setTimeout(() => picture(wanted, 1600).catch(() => {}), 40);
}

function pressed(event) {
  const act = bench.points && keyOf(KEYS, event);
  if (!act) return;
  event.preventDefault();
  act();
}

/** A message of the server. @param {any} message */
function told(message) {
  if (message.type === "progress") working(t("step {n}, v'Pv {omega}", { n: message.step ?? message.iteration ?? 0, omega: significant(message.omega, 5) }));
  else if (message.type === "state" && !actions.busy && bench.state && isNew(message)) { working(""); renew(null); }
  else if (message.type === "error") { working(""); renew(null); }
  else if (message.type === "detected") { bench.arrived.push(message); frame.viewOf(JobsView)?.arrive(message); working(t("detecting {image}", { image: message.image })); }
  else if (message.type === "folder") changedOutside(message.changed);
  else if (message.type === "lost") document.body.classList.add("lost");
  else if (message.type === "connected") { document.body.classList.remove("lost"); if (!bench.state?.solved) renew(null); }
}

/** The selection, the views or the runs are others. @param {Set<string>} changed */
function followed(changed) {
  if (!bench.points) return;
  frame.drawPanes();
  if (changed.has("ids")) { markTree(); drawInspector(bench, actions); tables.draw(false); }
}

async function begin() {
  takeToken();
  await speak(wantedLanguage());
  start();
  frame.use(VIEWS);
  subscribe(followed);
  document.addEventListener("keydown", pressed);
  document.addEventListener("pointerover", ahead);
  addEventListener("error", (event) => tell(event.message, "bad"));
  addEventListener("unhandledrejection", (event) => tell(event.reason?.message ?? String(event.reason), "bad"));
  by("title").textContent = t("loading …");
  by("doing").append(make("output", { id: "working", class: "working", hidden: true }));
  try {
    await renew(null);
    live(told); // its cookie comes with the first answer
    if (bench.state?.waiting) working(t("adjusting …")); // a message tells when it is done
  } catch (error) { tell(error.message, "bad"); }
}

await begin();
