"""Decisions about a project: solved first, then written, and taken back; each one line of its history."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from adjust.model.errors import SurveyError
from survey.folder.replacing import changing, replace_parts
from survey.folder.text import atomic_write, read_text
from survey.jobs.adjusting.edits import changed_files, kept_name, left_out
from survey.jobs.excluding import FILE, author_name, included_rows, new_rows
from survey.project.declared.editing import with_datum, with_sigma_scale, with_treatment
from survey.project.exclusions import Exclusion, Name, Row, appended
from survey.project.finding import find
from survey.project.observed import IMAGES, Observed, union
from survey.project.project import DEFINITION_FILE, Project
from survey.project.reading import leaving_out, read_all, with_exclusions
from survey.report.language import message
from survey.solution.earlier.changes import Changes
from survey.workbench.resident import Resident, Watch
from survey.workbench.situation import CancelledError, ChangedError, Situation, Step, signature_of

if TYPE_CHECKING:
    from adjust.diagnosis.diagnosis import Candidate

_NONE: Mapping[str, str] = MappingProxyType({})


class Deciding(Resident):
    """A project folder about which is decided. Every method may be called from any thread.

    folder: or a project that was read, whose folder is meant: what is decided is written there. read_only: nothing is
    ever written. watch: called with (iteration, v'Pv) while something is adjusted.
    """

    def __init__(
        self, folder: str | Path | Project, *, read_only: bool = False, watch: Watch | None = None
    ) -> None:  # fmt: skip
        super().__init__(folder.folder if isinstance(folder, Project) else folder, read_only=read_only, watch=watch)
        self.n_unsaved = 0
        self._done: list[Step] = []
        self._undone: list[Step] = []

    @property
    def undoable(self) -> tuple[str, ...]:
        """What can be undone, the last decision first."""
        return tuple(s.label for s in reversed(self._done))

    @property
    def redoable(self) -> tuple[str, ...]:
        """What was undone and can be done again, the next first."""
        return tuple(s.label for s in reversed(self._undone))

    def reload(self) -> Changes | None:
        """Read the folder again and adjust it; decisions made before can not be undone any more."""
        with self._lock:
            changes = super().reload()
            self._done, self._undone = [], []
            return changes

    def preview(self, *names: str, excluded: bool = True) -> dict[str, object]:
        """What leaving ``names`` out (or taking them back) means, before it is done. Raises SurveyError."""
        now = self.situation
        observed = Observed(now.everything.survey, now.everything.spots)
        found = [self._name(observed, name) for name in names]
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

    def exclude(self, *names: str, reason: str, author: str = "", base: int | None = None) -> Changes | None:
        """Leave observations out, all of ``names`` or none, adjust, and write ``observations/exclusions.csv``.

        Nothing is written where that cannot be solved. base: the solution that the decision is about. Raises
        SurveyError; ChangedError where there is a newer one, or where others changed the folder.
        """
        return self.decide(exclude=names, reason=reason, author=author, base=base)

    def include(self, *names: str, reason: str = "", author: str = "", base: int | None = None) -> Changes | None:
        """Take back what was left out; otherwise as :meth:`exclude`."""
        return self.decide(include=names, reason=reason, author=author, base=base)

    def decide(
        self, *, exclude: Sequence[str] = (), include: Sequence[str] = (), texts: Mapping[str, str] = _NONE,
        reason: str = "", author: str = "", base: int | None = None, label: str = "", cold: bool = False,
    ) -> Changes | None:  # fmt: skip
        """Exclusions, inclusions and new texts of files (by path in the folder) as one decision; as :meth:`exclude`.

        cold: adjust from the beginning, not from the values of before.
        """
        with self._lock:
            self._check(base)
            now, rows = self.situation, list[Row]()
            if exclude and not reason.strip():
                raise SurveyError(f"{self.folder}: say why; the report lists it")
            if exclude:
                rows += new_rows(now.everything, exclude, reason, author)
            if include:
                rows += included_rows(now.everything, include, reason, author)
            label = label or ", ".join(f"{'exclude' if r.excluded else 'include'} {r.exclusion.name}" for r in rows)
            return self._decided(rows, texts, label, cold)

    def _decided(self, rows: Sequence[Row], texts: Mapping[str, str], label: str, cold: bool = False) -> Changes | None:
        now = self.situation
        step = Step(
            label, tuple(r.exclusion for r in rows if r.excluded),
            tuple(now.exclusions[r.exclusion.name] for r in rows if not r.excluded),
            {name: self._text(name) for name in texts}, dict(texts), cold, now.adjustment is None,
        )  # fmt: skip
        changes = self._apply(step, rows)
        self._done.append(step)
        self._undone = []
        return changes

    def _text(self, name: str) -> str:
        """What stands in a file of the folder."""
        if name == DEFINITION_FILE:
            return self.situation.definition_text
        return read_text(self.folder / name)

    @property
    def remedies(self) -> "tuple[Candidate, ...]":
        """What the diagnosis of the last adjustment, failed or not, says would mend it, the best first."""
        return () if self.diagnosis is None else self.diagnosis.candidates

    def apply_remedy(self, number: int, base: int | None = None) -> Changes | None:
        """Carry out candidate ``number`` (from 1) of :attr:`remedies`, as ``labsurvey adjust --try`` does.

        A file that is changed is kept as it was below ``kept/`` too. Otherwise as :meth:`exclude`; raises SurveyError
        where there is no such candidate, or where only a person can do it.
        """
        from survey.jobs.adjusting.trying import chosen_of, in_use, reason_of

        with self._lock:
            chosen = chosen_of(self.folder, [c.hypothesis for c in self.remedies], number)
            texts = {file.name: file.after for file in changed_files(self.folder, chosen)}
            names = in_use(self.situation.project, left_out(chosen))
            return self.decide(exclude=names, texts=texts, reason=reason_of(chosen), base=base,
                               label=f"remedy: {chosen.cause}", cold=True)  # fmt: skip

    def set_sigma_scale(self, group: str, factor: float, base: int | None = None) -> Changes | None:
        """Multiply all sigmas of a group, in survey.toml; otherwise as :meth:`exclude`."""
        text = with_sigma_scale(self.situation.definition_text, group, factor)
        return self.decide(texts={DEFINITION_FILE: text}, label=f"sigmas of {group} times {factor:g}", base=base)

    def set_treatment(self, name: str, treatment: str, base: int | None = None) -> Changes | None:
        """Make a parameter free, or hold it at its adjusted value, in survey.toml; otherwise as :meth:`exclude`.

        name: as in results: ``lens/X/k1``, ``point/B07``, ``station_from_camera/X``.
        """
        now = self.situation
        text = with_treatment(now.definition_text, now.project.survey, self.adjustment.estimates, name, treatment)
        return self.decide(texts={DEFINITION_FILE: text}, label=f"{name} {treatment}", base=base)

    def set_datum(
        self, kind: str, points: Sequence[str] = (), stations: Sequence[str] = (), base: int | None = None
    ) -> Changes | None:
        """Choose the datum, in survey.toml: ``given``, or ``inner`` over points and stations."""
        text = with_datum(self.situation.definition_text, kind, points, stations)
        return self.decide(texts={DEFINITION_FILE: text}, label=f"datum {kind}", base=base)

    def undo(self, base: int | None = None) -> Changes | None:
        """Take the last decision back. Raises SurveyError where there is none; else as :meth:`exclude`."""
        return self._again(self._done, self._undone, "undo", base)

    def redo(self, base: int | None = None) -> Changes | None:
        """Do again what was undone last; as :meth:`undo`."""
        return self._again(self._undone, self._done, "redo", base)

    def _again(self, source: list[Step], onto: list[Step], verb: str, base: int | None) -> Changes | None:
        with self._lock:
            self._check(base)
            if not source:
                raise SurveyError(f"{self.folder}: there is nothing to {verb}")
            step = source[-1]
            effect = step.reversed() if verb == "undo" else step
            who = author_name(self.situation.project.options.identification)
            rows = [Row(True, replace(one, author=one.author or who)) for one in effect.excluded]
            rows += [Row(False, replace(one, reason=verb, author=who)) for one in effect.included]
            changes = self._apply(effect, rows, step.unsolved and verb == "undo")
            onto.append(source.pop())
            return changes

    def _check(self, base: int | None) -> None:
        self._require_writable()
        if base is not None and base != self.version:
            raise ChangedError(f"the solution has changed since (now {self.version}, not {base}); look at it again")
        self._require_unchanged()

    def _require_unchanged(self) -> None:
        changed = self.changed_files()
        if changed:
            raise ChangedError(f"{self.folder}: {', '.join(changed)} changed meanwhile; load the project again")

    def _apply(self, step: Step, rows: Sequence[Row], may_fail: bool = False) -> Changes | None:
        """Solve first, then write, then take: what cannot be solved is not recorded, unless it was so before."""
        now, texts = self.situation, step.after
        for name, text in step.before.items():
            if text != self._text(name):
                raise ChangedError(f"{self.folder / name}: has changed since; undo cannot put it back")
        everything = read_all(self.folder, texts) if texts else now.everything
        exclusions = dict(now.exclusions)
        for row in rows:
            exclusions.pop(row.exclusion.name, None)
            if row.excluded:
                exclusions[row.exclusion.name] = row.exclusion
        trial = replace(
            now, everything=everything, project=leaving_out(everything, exclusions.values()), exclusions=exclusions,
            definition_text=texts.get(DEFINITION_FILE, now.definition_text),
        )  # fmt: skip
        if texts:  # which spot is which beacon may be another question now
            trial = replace(trial, identified=(), known_spots=frozenset())
        failure = None
        try:
            solved = self._solved(trial, "cold" if step.cold else "warm")
        except SurveyError as error:
            if not may_fail or isinstance(error, CancelledError):
                raise
            solved, failure = replace(trial, judgement=None), error
        signature = self._write(step, rows)
        changes = self._take(replace(self._as_written(solved), signature=signature), failure)
        self.n_unsaved += 1
        return changes

    def _write(self, step: Step, rows: Sequence[Row]) -> Mapping[str, tuple[int, int]]:
        """Write what was decided; the signature of the files then, taken while nobody else may write."""
        with changing(self.folder, inputs=True) as place:
            self._require_unchanged()
            kept = {kept_name(self.folder, name): step.before[name] for name in step.after} if step.cold else {}
            for name, text in {**kept, **step.after}.items():
                atomic_write(place / name, text)
            if rows:
                atomic_write(place / FILE, appended(self.folder / FILE, rows))
            replace_parts(self.folder)
            return signature_of(self.folder)

    def _as_written(self, situation: Situation) -> Situation:
        """With the hashes of the files as they are now, and the lines on which exclusions stand."""
        everything, exclusions = with_exclusions(situation.everything, self.folder)
        project = leaving_out(everything, exclusions.values())
        return replace(situation, everything=everything, project=project, exclusions=exclusions)

    def _name(self, observed: Observed, text: str) -> Name:
        for name in self.situation.exclusions:
            if str(name) == text:
                return name
        return find(observed, text)
