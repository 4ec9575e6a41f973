// Elements without markup: everything a project says arrives as text, never as HTML.

/**
 * An element with attributes, listeners (`onclick`), and children (elements or text).
 * @param {string} tag @param {Object<string, any>} [given] @param {...(Node|string|null|undefined|false)} children
 * @returns {any}
 */
export function make(tag, given = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(given)) {
    if (value === undefined || value === null || (value === false && !name.startsWith("aria-"))) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "class") element.className = value;
    else if (name === "data") Object.assign(element.dataset, value);
    else element.setAttribute(name, value === true && !name.startsWith("aria-") ? "" : String(value));
  }
  return fill(element, ...children);
}

/** New children instead of the old ones; none for null. @param {any} element @param {...(Node|string|null|undefined|false)} children */
export function fill(element, ...children) {
  element.replaceChildren(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

/** @param {string} id @returns {any} */
export const by = (id) => document.getElementById(id);

/** A button that says what it does and by which key. @param {string} text @param {() => void} act @param {string} [key] */
export function button(text, act, key = "", extra = {}) {
  return make("button", { type: "button", onclick: act, "aria-keyshortcuts": key || null, title: key ? `${text} (${key})` : null, ...extra }, text);
}

/** A link to a place of the page; its text may go on in the next line behind a slash or a low line. @param {string} hash @param {string} text */
export const link = (hash, text, extra = {}) => make("a", { href: hash, ...extra }, ...text.split(/(?<=[/_])/).flatMap((part, k) => (k ? [make("wbr"), part] : part)));

/**
 * A small table: head of texts, rows of texts or elements; columns in `right` hold numbers.
 * @param {string} name @param {string[]} head @param {any[][]} rows @param {number[]} [right]
 */
export function plainTable(name, head, rows, right = []) {
  const cell = (tag) => (value, k) => make(tag, { class: right.includes(k) ? "r" : "l", scope: tag === "th" ? "col" : null }, value ?? "–");
  return make("div", { class: "t" }, make("table", { "aria-label": name },
    make("thead", {}, make("tr", {}, ...head.map(cell("th")))),
    make("tbody", {}, ...rows.map((row) => make("tr", {}, ...row.map(cell("td")))))));
}

/**
 * A canvas that keeps the pixels of the screen and the size of its place; `draw(context, width, height)` in CSS pixels.
 * @param {string} label @param {(context: CanvasRenderingContext2D, width: number, height: number) => void} draw
 */
export function surface(label, draw) {
  const canvas = make("canvas", { tabindex: 0, role: "img", "aria-label": label });
  const context = canvas.getContext("2d");
  let waiting = false;
  const paint = () => {
    waiting = false;
    const ratio = devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width || !height) return;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    draw(context, width, height);
  };
  const redraw = () => { if (!waiting) { waiting = true; requestAnimationFrame(paint); } };
  new ResizeObserver(redraw).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  return { canvas, redraw };
}

/** The largest 1, 2 or 5 times a power of ten that is not larger. @param {number} x */
export function roundBelow(x) {
  const power = 10 ** Math.floor(Math.log10(x || 1));
  return power * ([5, 2, 1].find((k) => k * power <= x) ?? 1);
}

/**
 * A length to compare with, at the lower left of a drawing.
 * @param {CanvasRenderingContext2D} context @param {number} length px @param {number} y px from the top @param {string} text
 */
export function ruler(context, length, y, text) {
  context.font = "11px system-ui, sans-serif";
  context.setLineDash([]);
  context.lineJoin = "round";
  for (const [name, wide] of [["paper", 4], ["ink", 1.8]]) { // to be read on any picture
    context.strokeStyle = colour(name);
    context.lineWidth = wide;
    context.beginPath();
    context.moveTo(12, y - 4); context.lineTo(12, y); context.lineTo(12 + length, y); context.lineTo(12 + length, y - 4);
    context.stroke();
    if (name === "paper") context.strokeText(text, 18 + length, y + 2);
  }
  context.fillStyle = colour("ink");
  context.fillText(text, 18 + length, y + 2);
}

const colours = new Map();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => colours.clear());

/** The colour of a custom property as it is now, light or dark. @param {string} name @returns {string} */
export function colour(name) {
  if (!colours.has(name)) {
    const probe = by("probe") ?? document.body.appendChild(make("span", { id: "probe", hidden: true }));
    probe.style.color = `var(--${name})`;
    colours.set(name, getComputedStyle(probe).color);
  }
  return colours.get(name);
}
