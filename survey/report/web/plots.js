// Plots of one camera over its image, and of series: small pictures drawn from values, with their scale beside them.

import { rowAt } from "./columns.js";
import { colour, make, roundBelow, surface } from "./dom.js";
import { count, number, significant, t } from "./words.js";

/** From dark to bright, also for those who see no red or green (after viridis, eight stops). */
const RAMP = [[68, 1, 84], [70, 50, 127], [54, 92, 141], [39, 127, 142], [31, 161, 135], [74, 194, 109], [159, 218, 58], [253, 231, 37]];

const ARROW_EDGE = 20; // px about an image whose arrows may lead out of it

/** @param {number} x 0 to 1 */
export function ramp(x) {
  const at = Math.max(0, Math.min(1, x)) * (RAMP.length - 1), k = Math.min(RAMP.length - 2, Math.floor(at)), f = at - k;
  return `rgb(${RAMP[k].map((a, c) => Math.round(a + f * (RAMP[k + 1][c] - a))).join(",")})`;
}

/** The place of an image within a canvas: margins for the legend, same scale in both directions. */
function frame(size, width, height, right, edge) {
  const scale = Math.min((width - right - 2 * edge) / size[0], (height - 8 - 2 * edge) / size[1]);
  return { scale, x: edge, y: edge, w: size[0] * scale, h: size[1] * scale };
}

function legend(context, box, low, high, unit) {
  const x = box.x + box.w + 10, h = Math.max(40, box.h), steps = 40;
  for (let k = 0; k < steps; k++) { context.fillStyle = ramp(1 - k / (steps - 1)); context.fillRect(x, box.y + (k * h) / steps, 12, h / steps + 1); }
  context.fillStyle = colour("ink");
  context.font = "11px system-ui, sans-serif";
  [1, 0.5, 0].forEach((share) => context.fillText(significant(low + share * (high - low), 2), x + 16, box.y + 9 + (1 - share) * (h - 10)));
  context.fillText(unit, x, box.y + h + 13);
}

/**
 * Values on a regular grid over an image (rows from the top), with arrows where there are any.
 * @param {string} label
 * @param {{size: number[], columns: number, rows: number, values: (number|null)[], unit: string, low?: number, high?: number, said?: string, arrows?: number[][], counts?: boolean}} grid
 *   arrows: u, v, du, dv (px)
 */
export function heat(label, grid) {
  const known = grid.values.filter((x) => x !== null && Number.isFinite(x)), high = grid.high ?? Math.max(...known, 1e-300), low = grid.low ?? Math.min(...known, high);
  const scaled = known.length > 0 && high > low;
  const longest = Math.max(...(grid.arrows ?? []).map((a) => Math.hypot(a[2], a[3])), 1e-300);
  const { canvas } = surface(label, (context, width, height) => {
    const box = frame(grid.size, width, height, scaled ? 70 : 0, grid.arrows?.length ? ARROW_EDGE : 8), dx = box.w / grid.columns, dy = box.h / grid.rows;
    grid.values.forEach((value, k) => {
      context.fillStyle = value === null || !Number.isFinite(value) ? colour("sunk") : ramp(high > low ? (value - low) / (high - low) : 0.7);
      context.fillRect(box.x + (k % grid.columns) * dx, box.y + Math.floor(k / grid.columns) * dy, dx + 0.5, dy + 0.5);
    });
    if (grid.arrows) {
      const grow = Math.min(1.6 * Math.min(dx, dy), ARROW_EDGE + 0.5 * Math.min(dx, dy) - 4) / longest; // none leaves the picture
      for (const [u, v, du, dv] of grid.arrows) arrow(context, box.x + (u + 0.5) * box.scale, box.y + (v + 0.5) * box.scale, grow * du, grow * dv);
    }
    context.strokeStyle = colour("edge");
    context.lineWidth = 1;
    context.strokeRect(box.x, box.y, box.w, box.h);
    if (scaled) legend(context, box, low, high, grid.unit);
  });
  const size = grid.counts ? count : (x) => significant(x, 3), arrows = grid.arrows?.length ? `; ${t("longest arrow {size} px", { size: significant(longest, 2) })}` : "";
  const said = grid.said ?? (known.length ? t("from {a} to {b} {unit}", { a: size(low), b: size(high), unit: grid.unit }) + arrows : t("no values"));
  return figure(label, said, canvas);
}

function arrow(context, x, y, dx, dy) {
  const far = Math.hypot(dx, dy), head = Math.min(4, far / 2);
  for (const [style, width] of [["rgba(0,0,0,0.7)", 3], ["#fff", 1.3]]) {
    context.strokeStyle = style;
    context.lineWidth = width;
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(x + dx, y + dy);
    if (far > 2) { const a = Math.atan2(dy, dx); for (const turn of [2.6, -2.6]) { context.moveTo(x + dx, y + dy); context.lineTo(x + dx + head * Math.cos(a + turn), y + dy + head * Math.sin(a + turn)); } }
    context.stroke();
  }
}

/**
 * Values at the pixels of a regular grid of which some may be missing, with an arrow at every second one.
 * @param {number[]} size @param {number[][]} uv @param {(number|null)[]} values @param {number[][]} [shifts]
 */
export function gridOf(size, uv, values, shifts) {
  const at = (k) => [...new Set(uv.map((x) => x[k]))].sort((a, b) => a - b), [us, vs] = [at(0), at(1)];
  const u = new Map(us.map((x, k) => [x, k])), v = new Map(vs.map((x, k) => [x, k])), all = new Array(us.length * vs.length).fill(null);
  uv.forEach((x, k) => { all[v.get(x[1]) * us.length + u.get(x[0])] = values[k]; });
  const arrows = shifts && uv.map((x, k) => [...x, ...shifts[k]]).filter((x) => u.get(x[0]) % 2 === 0 && v.get(x[1]) % 2 === 0 && Number.isFinite(x[2]));
  return { size, columns: Math.max(1, us.length), rows: Math.max(1, vs.length), values: all, unit: "px", low: 0, arrows };
}

/** A picture with its title and the same facts in words. */
export function figure(title, said, ...parts) {
  return make("figure", {}, make("figcaption", {}, make("b", {}, title), " ", make("span", { class: "quiet" }, said)), ...parts);
}

/**
 * The residuals of a camera in bins: mean vectors over the root of the mean square, and how many points there are.
 * @param {any} points @param {string} camera @param {number[]} size
 */
export function residualField(points, camera, size) {
  const columns = 16, rows = Math.max(4, Math.round((columns * size[1]) / size[0]));
  const n = new Float64Array(columns * rows), sums = [new Float64Array(n.length), new Float64Array(n.length), new Float64Array(n.length)];
  for (const [k, image] of points.images.entries()) {
    if (!image.startsWith(`${camera}/`)) continue;
    for (let j = points.first[k]; j < points.first[k + 1]; j++) {
      const i = rowAt(points, j), a = Math.min(columns - 1, Math.max(0, Math.floor((points.u[i] / size[0]) * columns))), b = Math.min(rows - 1, Math.max(0, Math.floor((points.v[i] / size[1]) * rows))), at = b * columns + a;
      if (!points.used[i] || !Number.isFinite(points.du[i])) continue;
      n[at]++;
      sums[0][at] += points.du[i];
      sums[1][at] += points.dv[i];
      sums[2][at] += points.du[i] ** 2 + points.dv[i] ** 2;
    }
  }
  const centre = (k) => [((k % columns) + 0.5) * size[0] / columns - 0.5, (Math.floor(k / columns) + 0.5) * size[1] / rows - 0.5];
  const arrows = [...n.keys()].filter((k) => n[k] >= 3).map((k) => [...centre(k), sums[0][k] / n[k], sums[1][k] / n[k]]);
  return {
    field: { size, columns, rows, unit: "px", low: 0, values: [...n].map((m, k) => (m ? Math.sqrt(sums[2][k] / (2 * m)) : null)), arrows },
    coverage: { size, columns, rows, unit: t("points"), low: 0, counts: true, values: [...n].map((m) => m || null), arrows: undefined },
  };
}

/** Round numbers within bounds, about five of them, each with its text. @param {number} low @param {number} high @returns {[number, string][]} */
function rounds(low, high) {
  if (!(high > low)) return [[low, significant(low, 3)]];
  const step = roundBelow((high - low) / 4), first = Math.ceil(low / step - 1e-9), digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return Array.from({ length: Math.floor(high / step + 1e-9) - first + 1 }, (_, k) => [(first + k) * step, digits > 9 ? significant((first + k) * step, 3) : number((first + k) * step, digits)]);
}

/**
 * Values over a quantity, one series each; a click goes to the place of a value.
 * @param {string} label @param {{name: string, x: number[], y: number[], anchors?: [string, string][]}[]} series
 * @param {{x: string, y: string, band?: number, onpick?: (kind: string, id: string) => void}} how band: |y| beyond it is suspect
 */
export function scatter(label, series, how) {
  const xs = series.flatMap((s) => s.x), ys = series.flatMap((s) => s.y).filter(Number.isFinite);
  const x0 = Math.min(...xs), x1 = Math.max(...xs), top = Math.max(...(how.band ? [1.5 * how.band] : ys.map(Math.abs)), 1e-12) * 1.08; // what is far beyond the band is an arrow at the edge
  let places = [];
  const { canvas } = surface(label, (context, width, height) => {
    const left = 52, bottom = 30, to = (x, y) => [left + ((x - x0) / Math.max(1e-300, x1 - x0)) * (width - left - 16), 8 + (0.5 - y / (2 * top)) * (height - bottom - 8)];
    context.font = "11px system-ui, sans-serif";
    context.lineWidth = 1;
    for (const [y, text] of rounds(-top, top)) {
      const [, v] = to(x0, y);
      context.strokeStyle = colour(y ? "rule" : "edge");
      context.beginPath(); context.moveTo(left, v); context.lineTo(width - 12, v); context.stroke();
      context.fillStyle = colour("quiet");
      context.fillText(text, 2, v + 4);
    }
    context.textAlign = "center";
    for (const [x, text] of rounds(x0, x1)) context.fillText(text, to(x, 0)[0], height - 16);
    context.textAlign = "left";
    context.fillText(`${how.x}  →      ↑ ${how.y}`, left, height - 3);
    if (how.band) for (const y of [-how.band, how.band]) { const [, v] = to(x0, y); context.strokeStyle = colour("bad"); context.setLineDash([5, 4]); context.beginPath(); context.moveTo(left, v); context.lineTo(width - 12, v); context.stroke(); context.setLineDash([]); }
    places = [];
    series.forEach((one, k) => one.x.forEach((x, i) => {
      if (!Number.isFinite(one.y[i])) return;
      const far = Math.abs(one.y[i]) > top, sign = Math.sign(one.y[i]), [u, v] = to(x, far ? (sign * top) / 1.03 : one.y[i]);
      places.push([u, v, one.anchors?.[i]]);
      context.fillStyle = context.strokeStyle = colour(["blue", "warn", "good", "soft"][k % 4]);
      context.beginPath();
      if (far) { context.moveTo(u, v - 6 * sign); context.lineTo(u + 5, v + 4 * sign); context.lineTo(u - 5, v + 4 * sign); context.fillText(significant(one.y[i], 3), u + 7, v + 4); }
      else if (k % 2) context.rect(u - 3, v - 3, 6, 6);
      else context.arc(u, v, 3.4, 0, 7);
      if (k % 4 > 1) context.stroke();
      else context.fill();
    }));
  });
  canvas.addEventListener("click", (event) => {
    const near = places.filter((p) => p[2]).map((p) => [Math.hypot(p[0] - event.offsetX, p[1] - event.offsetY), p[2]]).sort((a, b) => a[0] - b[0])[0];
    if (near && near[0] < 14) how.onpick?.(...near[1]);
  });
  return figure(label, [...series.map((s, k) => `${k % 2 ? "■" : "●"} ${s.name} (${count(s.x.length)})`), ...(how.band ? [`- - ${t("limit of {y}", { y: how.y })}`] : [])].join("   "), canvas);
}

