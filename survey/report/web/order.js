// Order and choice of many rows over typed arrays: a million without a pause.

const INDEX = 2 ** 21; // two million rows: key (32 bits) and row (21 bits) together are exact in a double

/**
 * Rows in the order of numbers, those without a number last; equal ones stay as they were.
 * @param {ArrayLike<number>} values @param {boolean} up @param {boolean} size by absolute value
 * @returns {Uint32Array}
 */
export function orderOf(values, up, size = false) {
  const n = values.length, keys = new Float64Array(n), single = new Float32Array(1), bits = new Uint32Array(single.buffer);
  if (n > INDEX) return Uint32Array.from(values, (_, i) => i).sort((a, b) => (up ? 1 : -1) * (values[a] - values[b]) || a - b);
  for (let i = 0; i < n; i++) {
    const value = size ? Math.abs(values[i]) : values[i];
    let key = 0xffffffff;
    if (value === value && value !== null) {
      single[0] = up ? value : -value;
      key = bits[0] & 0x80000000 ? ~bits[0] >>> 0 : (bits[0] | 0x80000000) >>> 0;
    }
    keys[i] = key * INDEX + i;
  }
  keys.sort();
  const out = new Uint32Array(n);
  for (let i = 0; i < n; i++) out[i] = keys[i] % INDEX;
  keys.buffer.transfer?.(0); // given back at once: whoever sorts again and again does not wait for the sweep
  return out;
}

/** Places of names in the order of people: n2 before n10. @param {string[]} names @returns {Uint32Array} */
export function ranks(names) {
  const compare = new Intl.Collator(undefined, { numeric: true }).compare;
  const out = new Uint32Array(names.length);
  names.map((name, i) => /** @type {[string, number]} */ ([name, i])).sort((a, b) => compare(a[0], b[0])).forEach(([, i], k) => { out[i] = k; });
  return out;
}

/**
 * @typedef {{key: string, title: string, names?: string[], codes?: ArrayLike<number>, code?: (i: number) => number,
 *   values?: ArrayLike<number>, digits?: number, size?: boolean, text?: (i: number) => string, wide?: number,
 *   label?: string}} Column
 * names with codes (or what tells the code of a row: a million need no array of them), or values; `size`: large ones are
 * of interest whatever their sign; `label`: what a column without a title is called where it is not seen
 */

/** What tells the place of a row's name among the names of its column. @param {Column} column @returns {(i: number) => number} */
export const codeOf = ({ code, codes }) => code ?? ((i) => /** @type {ArrayLike<number>} */ (codes)[i]);

/** Conditions like `w>3`, `used=0` and words; all must hold. @param {string} text @param {Column[]} columns */
export function conditions(text, columns) {
  const tests = [];
  for (const word of text.trim().split(/\s+/).filter(Boolean)) {
    const found = word.match(/^([^<>=]+)(<=|>=|<|>|=)(-?[\d.,]+)$/);
    const column = found && columns.find((c) => c.values && c.key.toLowerCase() === found[1].toLowerCase());
    if (found && column) {
      const limit = Number(found[3].replace(",", ".")), values = /** @type {ArrayLike<number>} */ (column.values);
      const at = column.size && found[2].startsWith(">") ? (i) => Math.abs(values[i]) : (i) => values[i];
      tests.push({ "<": (i) => at(i) < limit, ">": (i) => at(i) > limit, "<=": (i) => at(i) <= limit, ">=": (i) => at(i) >= limit, "=": (i) => at(i) === limit }[found[2]]);
    } else {
      const wanted = word.toLowerCase();
      const flags = columns.filter((c) => c.names).map((c) => /** @type {[(i: number) => number, Uint8Array]} */ ([codeOf(c), Uint8Array.from(/** @type {string[]} */ (c.names), (name) => Number(name.toLowerCase().includes(wanted)))]));
      tests.push((i) => flags.some(([code, hit]) => hit[code(i)]));
    }
  }
  return tests;
}

/** The rows of an order that meet all conditions. @param {Uint32Array} order @param {((i: number) => boolean)[]} tests */
export function chosen(order, tests) {
  if (!tests.length) return order;
  const out = new Uint32Array(order.length);
  let n = 0;
  for (const i of order) if (tests.every((test) => test(i))) out[n++] = i;
  return out.subarray(0, n);
}
