// What may be done with the survey: each asks the server, which solves first and then writes.

import { by } from "./dom.js";
import { number, t } from "./words.js";
import { current, names } from "./store.js";
import { post } from "./source.js";
import { sceneOf } from "./shapes.js";
import { askReason, previewText, tell } from "./dialogs.js";
import { changedShortly } from "./compare.js";
import { chosenNames } from "./inspector.js";
import { show } from "./frame.js";
import { working } from "./header.js";
import { bench } from "./bench.js";

/** @param {(answer: any) => Promise<void>} renew shows what came of it; null: what there is now
 *  @param {() => void} outside says which files others changed */
export function actionsOf(renew, outside) {
  let busy = false;
  const base = () => ({ base: bench.state.version });

  /** Something that makes a new solution; what the server refuses is said in its words. */
  async function act(ask, said = "") {
    if (busy) { tell(t("Still adjusting; Esc gives it up.")); return; }
    busy = true;
    const started = performance.now();
    document.body.setAttribute("aria-busy", "true");
    working(t("adjusting …"));
    try {
      await renew(await ask());
      tell(said || t("Done in {s} s.", { s: number((performance.now() - started) / 1000, 2) }) + changedShortly(bench.state.changes));
    } catch (error) {
      tell(error.status === 409 ? t("Not done: {why}", { why: error.message }) : error.message, "warn");
      if (error.status === 409) await renew(null).catch(() => {});
    } finally {
      busy = false;
      outside();
      working("");
      document.body.removeAttribute("aria-busy");
    }
    document.body.dataset.done = String(Math.round(performance.now() - started));
  }

  const actions = {
    show,
    done: renew,
    get busy() { return busy; },

    async exclude(chosen) {
      if (!chosen.length || bench.state.read_only) return;
      const changes = chosen.map((name) => ({ name, excluded: true }));
      const said = post("preview", { changes }).then((p) => ({ text: previewText(p), lost: p.epochs_lost?.length || p.images_lost?.length }));
      const reason = await askReason(chosen, said);
      if (reason) await act(() => post("exclusions", { ...base(), reason, changes }));
    },

    async include(chosen) {
      if (chosen.length && !bench.state.read_only) await act(() => post("exclusions", { ...base(), changes: chosen.map((name) => ({ name, excluded: false })) }));
    },

    /** Left out, or taken back where it is left out already. */
    toggle() {
      const chosen = chosenNames(), out = new Set(bench.state.exclusions.map((row) => row.name)), gone = chosen.filter((name) => out.has(name));
      if (!chosen.length) tell(t("Choose something first."));
      else if (gone.length) actions.include(gone);
      else actions.exclude(chosen);
    },

    /** The whole image of what is chosen. */
    image() {
      const { kind, ids } = current(), image = kind === "image" ? ids[0] : kind === "obs" ? names(ids[0]).ids.slice(0, 2).join("/") : "";
      if (image) actions.exclude([`image:${image}`]);
    },

    /** Another job: what it said is kept, what it drew is shown in the scene. */
    job: (name, ask) => act(async () => {
      const told = await ask();
      Object.assign(bench, { told: { ...bench.told, [name]: told }, toldAt: bench.toldAt + 1, drawn: told.drawn });
      if (told.drawn.scene) bench.planned = sceneOf(told.drawn.scene);
      return told;
    }, t("Done.")),

    setting: (change) => act(() => post("definition", { ...base(), ...change })),
    remedy: (number) => act(() => post("remedy", { ...base(), number })),
    undo: () => bench.state.undo.length && act(() => post("undo", base())),
    redo: () => bench.state.redo.length && act(() => post("redo", base())),
    adjust: (mode = "warm") => act(() => post("adjust", { ...base(), mode })),
    save: () => act(() => post("save", base()), t("Saved.")),
    reload: () => act(() => post("reload", {})),
    /** Gives up what runs, or takes the message away. */
    giveUp() { if (busy) post("cancel").catch(() => {}); else by("message").replaceChildren(); },
  };
  return actions;
}
