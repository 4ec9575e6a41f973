// Questions: why something is left out, and which key does what.

import { button, by, make } from "./dom.js";
import { t } from "./words.js";

let lastReason = sessionStorage.getItem("reason") ?? "";

/** The reason given last. */
export const reason = () => lastReason;

/**
 * A question with fields; resolves to true when confirmed, false when dropped. Escape drops it.
 * @param {string} title @param {Node[]} body @param {string} yes
 * @returns {Promise<boolean>}
 */
export function question(title, body, yes) {
  return new Promise((resolve) => {
    const dialog = make("dialog", { "aria-label": title }, make("form", { method: "dialog" }, make("h2", {}, title), ...body,
      make("p", { class: "actions" }, make("button", { type: "button", value: "no", onclick: () => dialog.close("no") }, t("Cancel")), make("button", { value: "yes", class: "primary" }, yes))));
    dialog.addEventListener("close", () => { dialog.remove(); resolve(dialog.returnValue === "yes"); });
    document.body.append(dialog);
    dialog.showModal();
  });
}

/**
 * Why? The reason given last is proposed; what goes with it is said before.
 * @param {string[]} things @param {Promise<any>} preview what the server says would go @returns {Promise<string|null>}
 */
export async function askReason(things, preview) {
  const field = make("input", { name: "reason", required: true, value: lastReason, maxlength: 200, autocomplete: "off" });
  const told = make("p", { class: "quiet", "aria-live": "polite" }, t("counting …"));
  preview.then((said) => { told.textContent = said.text; told.className = said.lost ? "warn" : "quiet"; }, (error) => { told.textContent = error.message; told.className = "warn"; });
  const shown = things.slice(0, 6).join(", ") + (things.length > 6 ? ` … (${things.length})` : "");
  queueMicrotask(() => field.select());
  const yes = await question(t("Leave out"), [make("p", {}, make("b", {}, shown)), told, make("label", {}, t("Reason"), field)], t("Leave out"));
  if (!yes || !field.value.trim()) return null;
  lastReason = field.value.trim();
  sessionStorage.setItem("reason", lastReason);
  return lastReason;
}

/** What leaving something out would take with it. @param {any} p answer of the server */
export function previewText(p) {
  const lost = [...(p.epochs_lost ?? []).map((e) => t("epoch {id} loses its only image", { id: e })), ...(p.images_lost ?? []).slice(0, 5).map((i) => t("image {id} has no points any more", { id: i }))];
  return [t("Leaves out: {what}", { what: p.text }), ...lost].join(". ");
}

const READ_MS = 8000;

/** A message; a warning stays until it is read. @param {string} text @param {string} [kind] warn or bad */
export function tell(text, kind = "") {
  const shown = make("span", { class: kind }, text);
  by("message").replaceChildren(shown, button("×", () => by("message").replaceChildren(), "", { "aria-label": t("close") }));
  if (!kind) setTimeout(() => { if (shown.isConnected) by("message").replaceChildren(); }, READ_MS);
}

/** @param {[string, string][]} keys key and what it does */
export function showKeys(keys) {
  const dialog = make("dialog", { "aria-label": t("Keys") }, make("h2", {}, t("Keys")),
    make("dl", { class: "keys" }, ...keys.flatMap(([key, does]) => [make("dt", {}, make("kbd", {}, key)), make("dd", {}, does)])),
    make("form", { method: "dialog" }, make("button", { class: "primary" }, t("Close"))));
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
}
