// From the server's answers to what the views draw.

import { rowAt } from "./columns.js";
import { matrix } from "./ellipsoids.js";
import { parts } from "./store.js";

/** Until there is a solution, what the results in the folder say stands for it. @param {any} raw answer of /api/state */
export function stateOf(raw) {
  const found = raw.solution ?? (raw.failure ? null : raw.kept), waiting = raw.solution === null && !raw.failure && !raw.empty;
  return { ...raw, ...found, version: raw.version, title: raw.title || raw.folder, reason: found?.reason ?? raw.failure ?? "", verdict: found?.verdict ?? (raw.failure ? "failed" : waiting ? "check" : ""),
    solved: raw.solution !== null, known: Boolean(found), waiting };
}

/** Image sizes by camera. @param {any} raw */
export const sizesOf = (raw) => Object.fromEntries(raw.tree.cameras.map((c) => [c.id, c.size]));

/** @param {any} raw */
export const readingsOf = (raw) => raw.rows;

/** Columns to rows, with the whole name of each component. @param {any} raw */
export function parametersOf(raw) {
  const c = Object.fromEntries(Object.entries(raw.columns).map(([key, column]) => [key, column.codes?.map((k) => column.texts[k]) ?? column]));
  return c.name.map((name, i) => ({ name: `${name}/${c.component[i]}`, owner: name, component: c.component[i], value: c.value[i], unit: c.unit[i], sigma: c.sigma[i], sigma_unit: c.sigma_unit[i], treatment: c.status[i] }));
}

/** @param {any} raw findings @param {any} state */
export function findingsOf(raw, state) {
  const rows = raw.findings.map((f) => ({ ...f, place: parts(f.anchor)[0], text: f.id.replace(/^\w+:/, "") + (f.component ? ` ${f.component}` : "") }));
  return { ...raw, suspects: rows.filter((f) => f.why !== 0 || f.share === null || f.share > 1), largest: rows.filter((f) => f.why === 0 && f.share !== null && f.share <= 1),
    groups: state.groups.map((g) => ({ id: g.group, n: g.n_observations, redundancy: g.redundancy, scale: g.factor === null ? null : Math.sqrt(g.factor), set: g.scale })) };
}

/** Poses of images (3x4 by rows), one frustum for each place of a camera; rays of every image to what it sees. @param {any} raw */
export function sceneOf(raw) {
  const shots = [], first = new Set(), places = new Set();
  for (const [image, pose] of Object.entries(raw.images)) {
    const camera = image.split("/")[0], main = !first.has(camera), place = `${camera}${pose.map((x) => x.toFixed(4)).join()}`;
    if (places.has(place)) continue;
    places.add(place);
    first.add(camera);
    shots.push({ camera, image, pose, main, half: raw.cameras[camera]?.half_angles_rad ?? [0.4, 0.3] });
  }
  return { ...raw, shots, poses: raw.images, spots: raw.spots.map((s) => ({ ...s, cov: matrix(s.cov) })),
    outlines: raw.outlines.map((o) => ({ id: o.target, x: o.x })), clouds: raw.clouds.map((c) => ({ id: c.target, x: c.x })) };
}

/** How far every point went (m) since the solution before. @param {any} before @param {any} after */
export function shiftsOf(before, after) {
  const old = new Map((before?.spots ?? []).map((s) => [s.id, s.x]));
  return new Map(after.spots.filter((s) => old.has(s.id)).map((s) => [s.id, s.x.map((x, k) => x - old.get(s.id)[k])]));
}

/** How many points of each image take no part. @param {any} data */
export function leftOut(data) {
  const out = new Map();
  for (let k = 0; k < data.images.length; k++) {
    let n = 0;
    for (let j = data.first[k]; j < data.first[k + 1]; j++) n += 1 - data.used[rowAt(data, j)];
    if (n) out.set(data.images[k], n);
  }
  return out;
}
