// Image points as columns: which rows an image, a point or a target has, and their names.

const ARRAYS = { u1: Uint8Array, u2: Uint16Array, u4: Uint32Array, i4: Int32Array, f4: Float32Array, f8: Float64Array };

/**
 * @typedef {{n: number, version: number, limit: number, blocks: {camera: string, epoch: string, target: string|null}[],
 *   points: Object<string, string[]>, block: ArrayLike<number>, point: ArrayLike<number>, u: Float32Array, v: Float32Array,
 *   du: Float32Array, dv: Float32Array, w: Float32Array, used: Uint8Array, why: Uint8Array, images: string[],
 *   imageIdx: Map<string, number>, imageOf: Uint32Array, first: Uint32Array, rows: Uint32Array|null}} Points
 */

/**
 * Columns: the length of a header (u32), the header (JSON, padded to four bytes), then the arrays one after the other.
 * @param {ArrayBuffer} buffer
 */
export function columns(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const out = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let at = 4 + length;
  for (const { name, type: kind } of out.columns) {
    const type = ARRAYS[kind];
    at = Math.ceil(at / type.BYTES_PER_ELEMENT) * type.BYTES_PER_ELEMENT;
    out[name] = new type(buffer, at, out.n);
    at += out[name].byteLength;
  }
  return out;
}

/** Rows of an image k are `rows[first[k]] ... rows[first[k + 1] - 1]`, without `rows` `first[k]` and so on. @param {any} data */
export function withImages(data) {
  const idx = new Map();
  const of = Uint32Array.from(data.blocks, (block) => {
    const key = `${block.camera}/${block.epoch}`;
    if (!idx.has(key)) idx.set(key, idx.size);
    return idx.get(key);
  });
  const first = new Uint32Array(idx.size + 1);
  for (let i = 0; i < data.n; i++) first[of[data.block[i]] + 1]++;
  for (let k = 0; k < idx.size; k++) first[k + 1] += first[k];
  let inOrder = true; // as tables are written: then a row needs no place of its own
  for (let i = 1; i < data.n; i++) inOrder &&= of[data.block[i]] >= of[data.block[i - 1]];
  const next = first.slice(), rows = inOrder ? null : new Uint32Array(data.n);
  for (let i = 0; rows && i < data.n; i++) rows[next[of[data.block[i]]]++] = i;
  return { ...data, images: [...idx.keys()], imageIdx: idx, imageOf: of, first, rows };
}

/** The row at a place of that order. @param {any} data @param {number} j */
export const rowAt = (data, j) => (data.rows ? data.rows[j] : j);

/** Rows of one image. @param {any} data @param {string} image camera/epoch @returns {Uint32Array} */
export function rowsOfImage(data, image) {
  const k = data.imageIdx.get(image);
  if (k === undefined) return new Uint32Array();
  const from = data.first[k], to = data.first[k + 1];
  return data.rows ? data.rows.subarray(from, to) : Uint32Array.from({ length: to - from }, (_, j) => from + j);
}

/** The name of the point of a row. @param {any} data @param {number} i */
export const pointName = (data, i) => data.points[data.blocks[data.block[i]].target ?? ""][data.point[i]];

/** The id of an image point: camera/epoch/target/point, without the target for a point of the world. @param {any} data @param {number} i */
export function pointId(data, i) {
  const block = data.blocks[data.block[i]];
  return [block.camera, block.epoch, ...(block.target ? [block.target] : []), pointName(data, i)].join("/");
}

/** The row of an image point, -1 where there is none. @param {any} data @param {string[]} ids */
export function rowOf(data, ids) {
  const wanted = ids.join("/");
  for (const i of rowsOfImage(data, `${ids[0]}/${ids[1]}`)) if (pointId(data, i) === wanted) return i;
  return -1;
}

/**
 * Rows of one point, of one target or of the world; numbers are compared, not names. @param {any} data
 * @param {string|null} target @param {string} name @param {string} [camera] @returns {number[]}
 */
export function rowsOfPoint(data, target, name, camera = "") {
  const at = (data.points[target ?? ""] ?? []).indexOf(name), out = [];
  const fits = Uint8Array.from(data.blocks, (b) => Number((b.target ?? null) === target && (!camera || b.camera === camera)));
  for (let i = 0; at >= 0 && i < data.n; i++) if (data.point[i] === at && fits[data.block[i]]) out.push(i);
  return out;
}

/** Rows of all blocks that fit. @param {any} data @param {(block: any) => boolean} test @returns {number[]} */
export function rowsWhere(data, test) {
  const fits = Uint8Array.from(data.blocks, (b) => Number(test(b))), out = [];
  for (let i = 0; i < data.n; i++) if (fits[data.block[i]]) out.push(i);
  return out;
}
