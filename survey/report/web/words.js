// Words and numbers in the language of the reader: texts by their English form, one JSON for each language; that of
// English holds only words that stand for a code (`kind obs`, `key next suspect`).

/** @type {Object<string, string>} */
let texts = {};
let language = "en";

/** What is said from now on. @param {string} wanted "en" or "de" @param {Object<string, string>} found */
export function use(wanted, found) {
  [texts, language] = [found, wanted]; // at once: something may be drawn while they are fetched
  document.documentElement.lang = wanted;
}

export const spoken = () => language;

/** A text, with `{name}` filled in; one that the language does not have is a bug that the tests find. @param {string} text */
export function t(text, values = {}) {
  if (language !== "en" && !(text in texts)) console.error(`no translation: ${text}`);
  return (texts[text] ?? text).replace(/\{(\w+)\}/g, (all, name) => (name in values ? String(values[name]) : all));
}

/** A word that may be data: translated where the language has it. @param {string} text */
export const known = (text) => texts[text] ?? text;

/** A group of observations: those of a kind in words. @param {string} id */
export const groupName = (id) => known(id.replaceAll("_", " "));

const formats = new Map();
/** A number with fixed decimals, a true minus, and a dash for none. @param {number|null|undefined} value @param {number} digits */
export function number(value, digits = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const key = `${language}${digits}`;
  if (!formats.has(key)) formats.set(key, new Intl.NumberFormat(language, { minimumFractionDigits: digits, maximumFractionDigits: digits }));
  return formats.get(key).format(value).replace("-", "−");
}

/** A count. @param {number} value */
export const count = (value) => number(value, 0);

/** A number to `digits` significant digits, for values whose size is not known beforehand. @param {number|null|undefined} value */
export function significant(value, digits = 4) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.floor(Math.log10(Math.abs(value))), decimals = digits - 1 - size;
  if (size < -7) { const [first, power] = value.toExponential(digits - 1).split("e"); return `${number(Number(first), digits - 1)}e${power.replace("-", "−")}`; }
  return number(value, Math.max(0, decimals));
}

/** A value with its unit, a dash alone for none. @param {number|null|undefined} value @param {string} [unit] */
export const measure = (value, unit = "", digits = 7) => (Number.isFinite(value) ? `${significant(value, digits)} ${unit}`.trim() : "–");

/** A value to two digits of its sigma, or as many as asked for; in full where it has none. @param {{value: number, unit?: string, sigma: number|null, sigma_unit?: string}} of */
export function estimated({ value, unit, sigma, sigma_unit: small }, digits = 2) {
  const own = sigma / (unit === "deg" && small === "arcsec" ? 3600 : 1);
  return own > 0 && (unit === small || unit === "deg") ? number(value, Math.min(12, Math.max(0, digits - 1 - Math.floor(Math.log10(own))))) : significant(value, 7);
}

/** A time as people read it. @param {string} iso */
export function time(iso) {
  const date = new Date(iso);
  return Number.isNaN(date.getTime()) ? iso : date.toLocaleString(language, { dateStyle: "medium", timeStyle: "short" });
}
