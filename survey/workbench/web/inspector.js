// What is known of the thing that is chosen, and what may be done with it.

import { button, by, fill, link, make, plainTable } from "./dom.js";
import { count, estimated, groupName, known, measure, number, significant, t } from "./words.js";
import { anchor, current, names } from "./store.js";
import { pointId, pointName, rowOf, rowsOfImage, rowsOfPoint, rowsWhere } from "./columns.js";

const WHY = ["in use", "used = false in its table", "excluded by people", "left out by this adjustment"];
const MOST = 40;
/** What survey.toml can hold and free in one line; of what is there for every epoch, only a person can. */
const HOLDABLE = /^((lens|table_geometry)\/[^/]+(\/[^/]+)?|(point|(station|carrier)_from_\w+|(world|mount)_from_(station|table))\/[^/]+)$/;

/** What a parameter is of, in words where there are some. @param {string} id */
function owns(id) {
  const [kind, owner] = id.split("/"), said = known(`param ${kind}`);
  return said.startsWith("param ") ? null : `${said} ${owner}`;
}

/** Names under which the chosen things are left out. @returns {string[]} */
export function chosenNames() {
  const { kind, ids } = current();
  if (kind === "obs") return ids;
  return ["image", "epoch", "camera", "target", "point", "reading"].includes(kind) ? ids.map((id) => `${kind}:${id}`) : [];
}

/** @param {any} bench @param {any} actions */
export function drawInspector(bench, actions) {
  const { kind, ids } = current(), id = ids[0];
  if (!kind || id === undefined) { fill(by("inspector"), ...survey(bench)); return; }
  const parts = (ABOUT[kind] ?? (() => []))(bench, id, actions) ?? [];
  fill(by("inspector"), make("h2", {}, `${t(`kind ${kind}`)} ${kind === "group" ? groupName(id) : id.replace(/^\w+:/, "")}`, ids.length > 1 ? make("span", { class: "pill" }, `+ ${ids.length - 1}`) : null), ...doing(bench, actions), ...parts,
    make("p", { class: "quiet anchor" }, anchor(kind, id)));
}

/** The survey as a whole, while nothing is chosen, and how something is. */
function survey({ state }) {
  const { tree, solution, datum } = state, images = tree.cameras.reduce((sum, c) => sum + c.images.length, 0);
  const key = (name, does) => [make("dt", {}, make("kbd", {}, name)), make("dd", {}, t(`key ${does}`))];
  return [make("h2", {}, t("Survey")), facts([[t("observations"), state.known ? count(state.n_observations) : undefined], [t("unknowns"), state.known ? count(state.n_unknowns) : undefined], [t("redundancy"), state.known ? count(state.redundancy) : undefined],
    ["sigma0", state.known ? number(state.sigma0, 4) : undefined], [t("sigmas"), solution ? known(solution.sigmas.replaceAll("_", " ")) : undefined], [t("Datum"), t(`datum ${datum.kind}`)], [t("adjusted in"), solution ? `${number(solution.seconds, 2)} s` : undefined],
    [t("Cameras"), tree.cameras.length || undefined], [t("Images"), images ? count(images) : undefined], [t("Stations"), tree.stations.length || undefined], [t("Targets"), tree.targets.length || undefined], [t("Points"), tree.points.length || undefined]]),
    make("p", { class: "quiet" }, t("Choose something: a suspect, a row, a point in an image or in space.")),
    make("dl", { class: "keys" }, ...key("j", "next suspect"), ...key("x", "leave out what is chosen (or take it back)"), ...key("d", "before and after"), ...key("u", "undo (also Ctrl-Z)"), ...key("?", "these keys"))];
}

function doing(bench, actions) {
  const chosen = chosenNames();
  if (!chosen.length || bench.state.read_only) return [];
  const out = new Set(bench.state.exclusions.map((row) => `${row.what}:${row.id}`)), gone = chosen.filter((name) => out.has(name));
  return [make("div", { class: "actions" }, gone.length ? button(t("Take back"), () => actions.include(gone), "e") : button(t("Leave out …"), () => actions.exclude(chosen), "x"))];
}

function facts(pairs) {
  return make("dl", { class: "facts" }, ...pairs.filter((pair) => pair && pair[1] !== undefined && pair[1] !== null).flatMap(([name, value]) => [make("dt", {}, name), make("dd", {}, value)]));
}

/** Numbers of some rows of image points. */
function sums(data, rows) {
  let used = 0, square = 0, n = 0, worst = -1;
  for (const i of rows) {
    if (data.used[i]) { used++; if (Number.isFinite(data.du[i])) { square += data.du[i] ** 2 + data.dv[i] ** 2; n++; } }
    if (Number.isFinite(data.w[i]) && (worst < 0 || data.w[i] > data.w[worst])) worst = i;
  }
  const out = rows.length - used;
  return facts([[t("image points"), count(rows.length)], [t("left out"), out ? count(out) : undefined], [t("root mean square"), n ? `${number(Math.sqrt(square / (2 * n)), 4)} px` : "–"],
    [t("largest w"), worst < 0 ? "–" : link(anchor("obs", `image_point:${pointId(data, worst)}`), `${number(data.w[worst], 2)}  ${pointName(data, worst)}`)]]);
}

/** The parameters whose name begins like this. */
const parameters = (bench, ...starts) => listed(bench.parameters.filter((p) => starts.some((start) => p.name === start || p.name.startsWith(`${start}/`))));

/** Parameters by what of their names is of interest. @param {any[]} rows @param {(parts: string[]) => string[]} [shortly] */
function listed(rows, shortly = (parts) => parts.slice(2)) {
  if (!rows.length) return [];
  return [make("h3", {}, t("Parameters")), plainTable(t("Parameters"), [t("parameter"), t("value"), t("sigma")], rows.slice(0, MOST).map((p) => [link(anchor("param", p.name), shortly(p.name.split("/")).join("/") || p.name), `${estimated(p)} ${p.unit}`, p.sigma === null || p.treatment === "held" ? known(p.treatment ?? "") || "–" : measure(p.sigma, p.sigma_unit, 2)]), [1, 2])];
}

/** Every observation of one point, worst first. */
function seenBy(data, found) {
  const rows = found.sort((a, b) => (data.w[b] || 0) - (data.w[a] || 0));
  return [make("h3", {}, t("Seen by {n} images", { n: count(rows.length) })), plainTable(t("Seen by"), [t("image"), t("residual, px"), "w"], rows.slice(0, MOST).map((i) => {
    const block = data.blocks[data.block[i]];
    return [link(anchor("obs", `image_point:${pointId(data, i)}`), `${block.camera}/${block.epoch}`, { class: data.used[i] ? "" : "out" }), number(Math.hypot(data.du[i], data.dv[i]), 3), number(data.w[i], 2)];
  }), [1, 2])];
}

const ABOUT = {
  obs(bench, id) {
    const { what, ids } = names(id), data = bench.points, i = what === "image_point" ? rowOf(data, ids) : -1;
    if (i < 0) return [make("p", { class: "warn" }, t("There is no such observation in this solution."))];
    const block = data.blocks[data.block[i]], name = pointName(data, i);
    return [facts([[t("image"), link(anchor("image", `${block.camera}/${block.epoch}`), `${block.camera}/${block.epoch}`)], [t("target"), block.target && link(anchor("target", block.target), block.target)],
      [t("point"), block.target ? name : link(anchor("point", name), name)], [t("observed"), `${number(data.u[i], 3)}, ${number(data.v[i], 3)} px`], [t("residual"), `${number(data.du[i], 4)}, ${number(data.dv[i], 4)} px`],
      ["w", `${number(data.w[i], 2)} (${number((100 * data.w[i]) / data.limit, 0)} % ${t("of the limit")})`], [t("redundancy"), data.redundancy && number(data.redundancy[i], 3)], [t("state"), t(WHY[data.why?.[i] ?? (data.used[i] ? 0 : 3)])]]),
    ...seenBy(data, rowsOfPoint(data, block.target, name, block.target ? block.camera : ""))];
  },
  image(bench, id) {
    const rows = rowsOfImage(bench.points, id), [camera, epoch] = id.split("/");
    return [sums(bench.points, rows), facts([[t("camera"), link(anchor("camera", camera), camera)], [t("kind epoch"), link(anchor("epoch", epoch), epoch)]])];
  },
  camera: (bench, id) => [sums(bench.points, rowsWhere(bench.points, (b) => b.camera === id)), ...parameters(bench, `lens/${id}`, `lens_crop/${id}`, `camera_clock/${id}`, `station_from_camera/${id}`, `lens_drift/${id}`)],
  epoch: (bench, id) => [sums(bench.points, rowsWhere(bench.points, (b) => b.epoch === id)), ...imagesOf(bench, (b) => b.epoch === id), ...parametersOfEpoch(bench, id)],
  target: (bench, id) => [sums(bench.points, rowsWhere(bench.points, (b) => b.target === id)), ...parameters(bench, `carrier_from_target/${id}`, `warp/${id}`, `target_points/${id}`)],
  point: (bench, id) => [...parameters(bench, `point/${id}`), ...seenBy(bench.points, rowsOfPoint(bench.points, null, id))],
  table: (bench, id) => parameters(bench, `world_from_table/${id}`, `table_geometry/${id}`, `table_motion/${id}`, `table_clock/${id}`),
  station: (bench, id) => parameters(bench, `mount_from_station/${id}`, `pose_clock/${id}`, `world_from_station/${id}`),
  reading(bench, id) {
    const rows = bench.readings.filter((row) => row.id === id);
    if (!rows.length) return [make("p", { class: "warn" }, t("There is no such observation in this solution."))];
    return [facts([[t("sort of reading"), known(rows[0].table.replaceAll("_", " "))], [t("group"), link(anchor("group", rows[0].group), groupName(rows[0].group))], [t("joins"), (rows[0].joins ?? []).join(", ") || undefined], [t("state"), t(WHY[rows[0].why ?? 0])]]),
      ...rows.map((row) => facts([[known(row.component) || t("component"), ""], [t("observed"), measure(row.observed, row.unit, 8)], [t("adjusted"), measure(row.adjusted, row.unit, 8)], [t("residual"), measure(row.residual, row.sigma_unit, 3)], [t("sigma"), measure(row.sigma, row.sigma_unit, 3)], ["w", number(row.w, 2)], [t("redundancy"), number(row.redundancy, 3)]]))];
  },
  param(bench, id, actions) {
    const row = bench.parameters.find((p) => p.name === id);
    if (!row) return parameters(bench, id);
    // a component of a lens or turntable by itself, poses and points as a whole, those of single epochs in survey.toml
    const single = /^(lens|table_geometry)\//.test(id), name = single ? id : row.owner, to = row.treatment === "free" ? "held" : "free";
    const acts = bench.state.read_only || !HOLDABLE.test(name) ? [] : [button(t(`make ${to}`), () => actions.setting({ parameter: name, treatment: to }))];
    return [facts([[t("what"), owns(id)], [t("value"), measure(row.value, row.unit, 9)], [t("sigma"), measure(row.sigma, row.sigma_unit, 3)], [t("treatment"), row.treatment && known(row.treatment)]]), make("div", { class: "actions" }, ...acts)];
  },
  group(bench, id, actions) {
    const group = (bench.findings.groups ?? []).find((g) => g.id === id);
    if (!group) return [];
    const field = make("input", { type: "number", min: "0", step: "any", value: "1", "aria-label": t("sigmas times") });
    return [facts([[t("observations"), count(group.n)], [t("redundancy"), number(group.redundancy, 1)], [t("sigmas fit ×"), number(group.scale, 3)]]),
      bench.state.read_only ? "" : make("div", { class: "actions" }, make("label", {}, t("sigmas times"), " ", field), button(t("Set"), () => actions.setting({ group: id, factor: Number(field.value) })))];
  },
};

const imagesOf = (bench, test) => {
  const images = [...new Set(bench.points.blocks.filter(test).map((b) => `${b.camera}/${b.epoch}`))];
  return [make("h3", {}, t("Images")), make("p", {}, ...images.slice(0, MOST).flatMap((image) => [link(anchor("image", image), image), " "]))];
};

const parametersOfEpoch = (bench, id) => {
  const of = bench.parameters.filter((p) => p.name.split("/")[2] === id);
  return listed(of, (parts) => parts.slice(1).filter((part) => part !== id));
};
