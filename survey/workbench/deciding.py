"""Decisions about a project: solved first, then written, and taken back; each one line of its history."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

from adjust.model.errors import SurveyError
from survey.folder.replacing import changing, replace_parts
from survey.folder.text import atomic_write, read_text
from survey.jobs.adjusting.edits import changed_files, kept_name, left_out
from survey.jobs.excluding import FILE, author_name, included_rows, new_rows
from survey.project.declared.editing import with_datum, with_sigma_scale, with_treatment
from survey.project.exclusions import Exclusion, Name, Row, appended, in_force
from survey.project.finding import find
from survey.project.observed import IMAGES, Observed, union
from survey.project.project import DEFINITION_FILE
from survey.project.reading import leaving_out, read_all, with_exclusions
from survey.report.language import message
from survey.solution.earlier.changes import Changes
from survey.solution.earlier.runs import definition_of, find_run
from survey.workbench.resident import Resident
from survey.workbench.situation import CancelledError, ChangedError, Situation, Step, signature_of

_NONE: Mapping[str, str] = MappingProxyType({})
_MOST_KEPT = 300_000  # image points of all solutions that are kept to be there again at once


def preview(bench: Resident, *names: str, excluded: bool = True) -> dict[str, object]:
    """What leaving ``names`` out (or taking them back) means, before it is done. Raises SurveyError."""
    now = bench.situation
    observed = Observed(now.everything.survey, now.everything.spots)
    found = [_name(bench, observed, name) for name in names]
    hits = union(observed.hits(name, observed.place_of(name)) for name in found)
    gone = leaving_out(now.everything, [*now.exclusions.values(), *(Exclusion(n) for n in found)]) \
        if excluded else now.project  # fmt: skip
    images = {(b.camera_id, b.epoch_id) for b in now.project.survey.image_blocks if b.n_used}
    kept = {(b.camera_id, b.epoch_id) for b in gone.survey.image_blocks if b.n_used}
    epochs = {e for _, e in images} - {e for _, e in kept}
    return {
        "names": [str(n) for n in found], "text": message(hits.text()), "n_image_points": hits.n_image_points,
        "n_readings": hits.n_readings, "n_spots": hits.n_spots, "n_images": len(hits.of(IMAGES)),
        "images_lost": ["/".join(x) for x in sorted(images - kept)], "epochs_lost": sorted(epochs),
    }  # fmt: skip


def exclude(bench: Resident, *names: str, reason: str, author: str = "", base: int | None = None) -> Changes | None:
    """Leave observations out, all of ``names`` or none, adjust, and write ``observations/exclusions.csv``.

    Nothing is written where that cannot be solved. base: the solution that the decision is about. Raises
    SurveyError; ChangedError where there is a newer one, or where others changed the folder.
    """
    return decide(bench, exclude=names, reason=reason, author=author, base=base)


def include(
    bench: Resident, *names: str, reason: str = "", author: str = "", base: int | None = None
) -> Changes | None:
    """Take back what was left out; otherwise as :func:`exclude`."""
    return decide(bench, include=names, reason=reason, author=author, base=base)


def decide(
    bench: Resident, *, exclude: Sequence[str] = (), include: Sequence[str] = (), texts: Mapping[str, str] = _NONE,
    reason: str = "", author: str = "", base: int | None = None, label: str = "", cold: bool = False,
) -> Changes | None:  # fmt: skip
    """Exclusions, inclusions and new texts of files (by path in the folder) as one decision; as :func:`exclude`.

    cold: adjust from the beginning, not from the values of before.
    """
    with bench.lock:
        bench.check(base)
        now, rows = bench.situation, list[Row]()
        if exclude and not reason.strip():
            raise SurveyError(f"{bench.folder}: say why; the report lists it")
        if exclude:
            rows += new_rows(now.everything, exclude, reason, author)
        if include:
            rows += included_rows(now.everything, include, reason, author)
        label = label or ", ".join(f"{'exclude' if r.excluded else 'include'} {r.exclusion.name}" for r in rows)
        return _decided(bench, rows, texts, label, cold)


def _decided(
    bench: Resident, rows: Sequence[Row], texts: Mapping[str, str], label: str, cold: bool = False
) -> Changes | None:
    now = bench.situation
    step = Step(
        label, tuple(r.exclusion for r in rows if r.excluded),
        tuple(now.exclusions[r.exclusion.name] for r in rows if not r.excluded),
        {name: _text(bench, name) for name in texts}, dict(texts), cold, now.adjustment is None,
    )  # fmt: skip
    changes = _apply(bench, step, rows)
    bench.done = _kept(*bench.done, replace(step, beyond=now))
    bench.undone = []
    return changes


def _kept(*steps: Step) -> list[Step]:
    """The last decisions with their solutions, those before without."""
    n_points, out = 0, list[Step]()
    for step in reversed(steps):
        n_points += 0 if step.beyond is None else sum(len(b.uv) for b in step.beyond.survey.image_blocks)
        out.append(step if n_points <= _MOST_KEPT else replace(step, beyond=None))
    return out[::-1]


def _text(bench: Resident, name: str) -> str:
    """What stands in a file of the folder."""
    if name == DEFINITION_FILE:
        return bench.situation.definition_text
    return read_text(bench.folder / name)


def apply_remedy(bench: Resident, number: int, base: int | None = None) -> Changes | None:
    """Carry out candidate ``number`` (from 1) of :attr:`remedies`, as ``labsurvey adjust --try`` does.

    A file that is changed is kept as it was below ``kept/`` too. Otherwise as :func:`exclude`; raises SurveyError
    where there is no such candidate, or where only a person can do it.
    """
    from survey.jobs.adjusting.trying import chosen_of, in_use, reason_of

    with bench.lock:
        chosen = chosen_of(bench.folder, [c.hypothesis for c in bench.remedies], number)
        texts = {file.name: file.after for file in changed_files(bench.folder, chosen)}
        names = in_use(bench.situation.project, left_out(chosen))
        return decide(bench, exclude=names, texts=texts, reason=reason_of(chosen), base=base,
                           label=f"remedy: {chosen.cause}", cold=True)  # fmt: skip


def set_sigma_scale(bench: Resident, group: str, factor: float, base: int | None = None) -> Changes | None:
    """Multiply all sigmas of a group, in survey.toml; otherwise as :func:`exclude`."""
    text = with_sigma_scale(bench.situation.definition_text, group, factor)
    return decide(bench, texts={DEFINITION_FILE: text}, label=f"sigmas of {group} times {factor:g}", base=base)


def set_treatment(bench: Resident, name: str, treatment: str, base: int | None = None) -> Changes | None:
    """Make a parameter free, or hold it at its adjusted value, in survey.toml; otherwise as :func:`exclude`.

    name: as in results: ``lens/X/k1``, ``point/B07``, ``station_from_camera/X``.
    """
    now = bench.situation
    text = with_treatment(now.definition_text, now.project.survey, bench.adjustment.estimates, name, treatment)
    return decide(bench, texts={DEFINITION_FILE: text}, label=f"{name} {treatment}", base=base)


def set_datum(
    bench: Resident, kind: str, points: Sequence[str] = (), stations: Sequence[str] = (), base: int | None = None
) -> Changes | None:
    """Choose the datum, in survey.toml: ``given``, or ``inner`` over points and stations."""
    text = with_datum(bench.situation.definition_text, kind, points, stations)
    return decide(bench, texts={DEFINITION_FILE: text}, label=f"datum {kind}", base=base)


def undo(bench: Resident, base: int | None = None) -> Changes | None:
    """Take the last decision back. Raises SurveyError where there is none; else as :func:`exclude`."""
    return _again(bench, bench.done, bench.undone, "undo", base)


def redo(bench: Resident, base: int | None = None) -> Changes | None:
    """Do again what was undone last; as :func:`undo`."""
    return _again(bench, bench.undone, bench.done, "redo", base)


def _again(bench: Resident, source: list[Step], onto: list[Step], verb: str, base: int | None) -> Changes | None:
    with bench.lock:
        bench.check(base)
        if not source:
            raise SurveyError(f"{bench.folder}: there is nothing to {verb}")
        step, now = source[-1], bench.situation
        effect = step.reversed() if verb == "undo" else step
        who = author_name(now.project.options.identification)
        rows = [Row(True, replace(one, author=one.author or who)) for one in effect.excluded]
        rows += [Row(False, replace(one, reason=verb, author=who)) for one in effect.included]
        changes = _apply(bench, effect, rows, step.unsolved and verb == "undo")
        source.pop()
        onto[:] = _kept(*onto, replace(step, beyond=now))
        return changes


def restore(bench: Resident, number: int, base: int | None = None) -> tuple[str, ...]:
    """survey.toml and exclusions as they were at a run, as one decision; what else has changed since, for people.

    Raises as :func:`exclude`, and where there is no such run.
    """
    with bench.lock:
        bench.check(base)
        run, text, now = find_run(bench.folder, number), definition_of(bench.folder, number), bench.situation
        then = {e.name: e for e in run.exclusions}
        who = author_name(now.project.options.identification)
        why = f"run {number}"
        rows = [Row(True, replace(e, line=0)) for name, e in then.items() if name not in now.exclusions]
        rows += [Row(False, replace(e, reason=why, author=who)) for n, e in now.exclusions.items() if n not in then]
        texts = {DEFINITION_FILE: text} if text != now.definition_text else {}
        if rows or texts:
            _decided(bench, rows, texts, f"restore run {number}")
        inputs = bench.situation.everything.inputs
        other = sorted(k for k in {*inputs, *run.hashes} if inputs.get(k) != run.hashes.get(k))
        known = {DEFINITION_FILE, FILE}
        return tuple(f"{name}: is not as it was at run {number}; it stays as it is" for name in other
                     if name not in known)  # fmt: skip


def _apply(bench: Resident, step: Step, rows: Sequence[Row], may_fail: bool = False) -> Changes | None:
    """Solve first, then write, then take: what cannot be solved is not recorded, unless it was so before."""
    now, texts = bench.situation, step.after
    for name, text in step.before.items():
        if text != _text(bench, name):
            raise ChangedError(f"{bench.folder / name}: has changed since; undo cannot put it back")
    everything = read_all(bench.folder, texts) if texts else now.everything
    exclusions = in_force(rows, now.exclusions)
    trial = replace(
        now, everything=everything, project=leaving_out(everything, exclusions.values()), exclusions=exclusions,
        definition_text=texts.get(DEFINITION_FILE, now.definition_text),
    )  # fmt: skip
    if texts:  # which spot is which beacon may be another question now
        trial = replace(trial, identified=(), known_spots=frozenset())
    failure = None
    try:
        solved = _known(step, trial) or bench.solved(trial, "cold" if step.cold else "warm")
    except SurveyError as error:
        if not may_fail or isinstance(error, CancelledError):
            raise
        solved, failure = replace(trial, judgement=None), error
    signature = _write(bench, step, rows)
    changes = bench.take(replace(_as_written(bench, solved), signature=signature), failure)
    bench.n_unsaved += 1
    return changes


def _known(step: Step, trial: Situation) -> Situation | None:
    """With the solution that was there already, where it rests on the same files and the same is left out."""
    there = step.beyond
    if there is None or there.judgement is None or there.basis != trial.basis:
        return None
    return trial.solved_as(there)


def _write(bench: Resident, step: Step, rows: Sequence[Row]) -> Mapping[str, tuple[int, int]]:
    """Write what was decided; the signature of the files then, taken while nobody else may write."""
    with changing(bench.folder, inputs=True) as place:
        bench.require_unchanged()
        kept = {kept_name(bench.folder, name): step.before[name] for name in step.after} if step.cold else {}
        for name, text in {**kept, **step.after}.items():
            atomic_write(place / name, text)
        if rows:
            atomic_write(place / FILE, appended(bench.folder / FILE, rows))
        replace_parts(bench.folder)
        return signature_of(bench.folder)


def _as_written(bench: Resident, situation: Situation) -> Situation:
    """With the hashes of the files as they are now, and the lines on which exclusions stand."""
    everything, exclusions = with_exclusions(situation.everything, bench.folder)
    project = leaving_out(everything, exclusions.values())
    return replace(situation, everything=everything, project=project, exclusions=exclusions)


def _name(bench: Resident, observed: Observed, text: str) -> Name:
    for name in bench.situation.exclusions:
        if str(name) == text:
            return name
    return find(observed, text)
