// The values that all views show: asked of the server, replaced as a whole, never changed in place.

import { get, points } from "./source.js";
import { findingsOf, leftOut, parametersOf, readingsOf, sceneOf, shiftsOf, sizesOf, stateOf } from "./shapes.js";

export const bench = {
  state: null, pictured: true, points: null, limit: 1, readings: [], findings: {}, sizes: {}, images: [], leftOut: new Map(), // of the observations
  parameters: [], scene: null, shifts: new Map(), // of the solution
  beginning: null, // instead of them: the state of a folder that is no project yet
  told: {}, toldAt: 0, arrived: [], drawn: null, planned: null, // of the other jobs
};

/**
 * Observations and what is wrong with them; whether they are others than before.
 * @param {any} answer a state, what a decision answered, or null to ask for the state
 * @param {boolean} [anew] also what has not changed, as in another language
 */
export async function load(answer, anew = false) {
  const raw = answer?.state ?? (answer?.version !== undefined && answer.exclusions ? answer : await get("state"));
  bench.beginning = raw.beginning ? raw : null;
  if (raw.beginning) return false;
  const state = stateOf(raw), old = bench.state;
  const fresh = anew || !old || old.version !== state.version || old.folder !== state.folder || (state.failure ?? "") !== (old.failure ?? "");
  if (!fresh) { bench.state = { ...state, changes: old.changes }; return false; }
  const [columns, readings, findings] = await Promise.all([points(old?.folder === state.folder ? bench.points : null), get("readings"), get("findings")]);
  Object.assign(bench, { state, pictured: raw.n_pictures > 0, points: columns, readings: readingsOf(readings), limit: readings.limit, findings: findingsOf(findings, raw), sizes: sizesOf(raw), images: raw.tree.cameras.flatMap((c) => c.images.map((epoch) => `${c.id}/${epoch}`)), leftOut: leftOut(columns) });
  if (!state.solved) Object.assign(bench, { parameters: [], scene: null, shifts: new Map() });
  state.changes = answer?.changes ?? (state.solved ? (await get("changes")).changes : null);
  return true;
}

/** What was estimated, behind the observations; whether it is still of the solution that is shown. */
export async function loadResults() {
  const { version } = bench.state, [parameters, raw] = await Promise.all([get("parameters"), get("scene")]), scene = sceneOf(raw);
  if (bench.state.version !== version) return false;
  Object.assign(bench, { parameters: parametersOf(parameters), scene, shifts: shiftsOf(bench.scene, scene) });
  return true;
}
