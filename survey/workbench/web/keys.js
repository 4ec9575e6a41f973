// The keys of the page: each is something that can be done with the mouse too.

import { showKeys } from "./dialogs.js";
import { chosenNames } from "./inspector.js";
import { t } from "./words.js";

/** Key, what it says under "?", and what it does. @param {any} page what may be done: actions, bench, tables, frame, and the views in sight */
export function keysOf({ actions, bench, tables, frame, ...page }) {
  const keys = [
    ["j", "next suspect", () => page.step(1)], ["k", "previous suspect", () => page.step(-1)],
    ["]", "next image", () => page.image()?.next(1)], ["[", "previous image", () => page.image()?.next(-1)],
    ["}", "next image of this epoch", () => page.image()?.next(1, true)], ["{", "previous image of this epoch", () => page.image()?.next(-1, true)],
    ["Enter", "show the image", () => frame.show("image", "right")],
    ["x", "leave out what is chosen (or take it back)", () => actions.toggle()], ["X", "leave out the whole image", () => actions.image()], ["e", "take back what is chosen", () => actions.include(chosenNames())],
    ["m", "carry out the first remedy", () => { if (bench.findings.remedies?.[0]?.possible && !bench.state.read_only) actions.remedy(1); }],
    ["a", "adjust again", () => actions.adjust("warm")], ["A", "adjust from the beginning", () => actions.adjust("cold")],
    ["u", "undo (also Ctrl-Z)", () => actions.undo()], ["U", "redo (also Ctrl-Shift-Z)", () => actions.redo()], ["s", "save (also Ctrl-S)", () => actions.save()],
    ["f", "filter the table", () => tables.find()],
    ["1", "project", () => frame.focus("tree")], ["2", "first view", () => frame.focus("left")], ["3", "second view", () => frame.focus("right")], ["4", "tables", () => frame.focus("tables")], ["5", "details", () => frame.focus("inspector")],
    ["+", "longer vectors, larger ellipsoids", () => page.enlarge(1)], ["-", "shorter vectors, smaller ellipsoids", () => page.enlarge(-1)],
    ["0", "the whole image or scene", () => frame.eachView((view) => view.whole?.())], ["o", "overlay on or off", () => page.image()?.toggle()],
    ["d", "before and after", () => frame.show("compare", "left")], ["v", "next view in this pane", () => frame.nextView(1)], ["V", "previous view in this pane", () => frame.nextView(-1)],
    ["g", "language", () => page.language()], ["Escape", "give up what is being adjusted", () => actions.giveUp()], ["?", "these keys", () => showKeys(keys.map(([key, does]) => [key, t(`key ${does}`)]))],
  ];
  return keys;
}

/** What a key does here; nothing in a field, a dialog, or with Enter on what Enter presses. @param {any[]} keys @param {KeyboardEvent|string} pressed */
export function keyOf(keys, pressed) {
  let key = pressed.key ?? pressed;
  if (typeof pressed !== "string") {
    const at = /** @type {Element} */ (pressed.target), lower = key.toLowerCase();
    if (at.closest("input, textarea, select, dialog") || pressed.altKey) return null;
    if (pressed.ctrlKey || pressed.metaKey) key = lower === "z" ? (pressed.shiftKey ? "U" : "u") : lower === "s" ? "s" : "";
    if (key === "Enter" && at.closest("button, a, summary, [role=grid]")) return null;
  }
  return keys.find((row) => row[0] === key)?.[2] ?? null;
}
