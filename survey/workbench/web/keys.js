// The keys of the page: each is something that can be done with the mouse too.

import { showKeys } from "./dialogs.js";
import { t } from "./words.js";

/** Key, what it says under "?", and what it does. @param {any} page what may be done: actions, bench, tables, and the functions of the frame */
export function keysOf(page) {
  const { actions, bench, tables } = page, keys = [
    ["j", "next suspect", () => page.step(1)], ["k", "previous suspect", () => page.step(-1)],
    ["]", "next image", () => page.image()?.next(1)], ["[", "previous image", () => page.image()?.next(-1)],
    ["}", "next image of this epoch", () => page.image()?.next(1, true)], ["{", "previous image of this epoch", () => page.image()?.next(-1, true)],
    ["Enter", "show the image", () => actions.show("image", "right")],
    ["x", "leave out what is chosen (or take it back)", () => actions.toggle()], ["X", "leave out the whole image", () => actions.image()], ["e", "take back what is chosen", () => actions.include(page.chosen())],
    ["m", "carry out the first remedy", () => { if (bench.findings.remedies?.[0]?.possible && !bench.state.read_only) actions.remedy(1); }],
    ["a", "adjust again", () => actions.adjust("warm")], ["A", "adjust from the beginning", () => actions.adjust("cold")],
    ["u", "undo (also Ctrl-Z)", () => actions.undo()], ["U", "redo (also Ctrl-Shift-Z)", () => actions.redo()], ["s", "save (also Ctrl-S)", () => actions.save()],
    ["f", "filter the table", () => tables.find()],
    ["1", "project", () => page.focus("tree")], ["2", "first view", () => page.focus("left")], ["3", "second view", () => page.focus("right")], ["4", "tables", () => page.focus("tables")], ["5", "details", () => page.focus("inspector")],
    ["+", "longer vectors, larger ellipsoids", () => page.enlarge(1)], ["-", "shorter vectors, smaller ellipsoids", () => page.enlarge(-1)],
    ["0", "the whole image or scene", () => page.whole()], ["o", "overlay on or off", () => { const view = page.image(); if (view) { view.overlay = !view.overlay; view.surface.redraw(); } }],
    ["d", "before and after", () => actions.show("compare", "left")], ["v", "next view in this pane", () => page.nextView(1)], ["V", "previous view in this pane", () => page.nextView(-1)],
    ["g", "language", () => page.language()], ["Escape", "give up what is being adjusted", () => { page.giveUp(); }], ["?", "these keys", () => showKeys(keys.map(([key, does]) => [key, t(`key ${does}`)]))],
  ];
  return keys;
}
