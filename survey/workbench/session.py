"""A project in memory that is adjusted again at every decision: what ``labsurvey open`` serves, and a notebook uses.

>>> bench = Workbench("lab")
>>> bench.adjust()
>>> bench.exclude("X/hX05", reason="motion blur").largest[:5]
>>> bench.undo()
>>> bench.save()

Three sets are kept apart: what a table marks ``used = false``, what people excluded, and what a run screened out by
itself. Only the third is found anew by every adjustment, which begins at the values of everything that was ever solved.
"""

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import numpy as np
from gtsam import Pose3

from adjust.graph.assembly import StartValues, values_of
from adjust.lenses.models import MODELS
from adjust.model.errors import SurveyError
from adjust.model.observations import ImageBlock
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, Survey
from survey.folder.locking import LOCK, holder_of
from survey.folder.replacing import changing, replace_parts
from survey.folder.text import atomic_write, decode, read_bytes
from survey.jobs.adjusting.job import AdjustOutcome, Clock, command_line, kept_run, made, run_info
from survey.jobs.adjusting.steps import adjust_project, seen_points
from survey.jobs.detecting import author_name
from survey.jobs.excluding import FILE, included_rows, new_rows
from survey.project import Project
from survey.project.declared.editing import with_datum, with_sigma_scale, with_treatment
from survey.project.exclusions import Exclusion, Name, Row, appended, in_force, read_exclusions
from survey.project.observed import Hits, Observed, union
from survey.project.project import DEFINITION_FILE, OBSERVATIONS_FOLDER, SpotBlock
from survey.project.reading import leaving_out, read_all
from survey.solution.changes import Changes, Snapshot, snapshot, solution_changes
from survey.solution.quantities import Scale, scale_of
from survey.solution.runs import definition_of, find_run, load_run, remove_empty
from survey.solution.statistics import Statistics, statistics_of
from survey.workbench.rows import PointRows, point_rows

Mode = Literal["warm", "cold"]
_Watch = Callable[[int, float], None]


class ChangedError(SurveyError):
    """What a decision was based on is not what there is any more: a newer solution, or files that others wrote."""


class CancelledError(SurveyError):
    """The adjustment was given up because somebody asked for that."""


@dataclass(frozen=True, eq=False)
class Situation:
    """A project as it is read, and its solution.

    everything: with all observations as its tables have them. project: without what people excluded. identified:
    blocks of the spots that have got a name, in the order of ``everything.survey.points``. known_spots: of which is
    known whether they have one. mode, seconds: how it was adjusted and how long that took.
    """

    everything: Project
    project: Project
    definition_text: str
    exclusions: Mapping[Name, Exclusion]
    signature: Mapping[str, tuple[int, int]]
    identified: tuple[ImageBlock, ...] = ()
    known_spots: frozenset[tuple[str, str, complex]] = frozenset()
    adjustment: Adjustment | None = None
    mode: Mode = "cold"
    seconds: float = 0.0

    @property
    def survey(self) -> Survey:
        """All observations, spots with a name among them."""
        survey = self.everything.survey
        return replace(survey, image_blocks=(*survey.image_blocks, *self.identified))

    @property
    def now(self) -> Survey:
        """The same blocks with what people left out."""
        survey = self.project.survey
        there = spot_places(self.project.spots)
        named = (replace(b, used=np.array([(b.camera_id, b.epoch_id, z) in there for z in _complex(b.uv)]))
                 for b in self.identified)  # fmt: skip
        return replace(survey, image_blocks=(*survey.image_blocks, *named))

    @property
    def left(self) -> Hits:
        """What people left out."""
        observed = Observed(self.everything.survey, self.everything.spots)
        return union(observed.hits(one.name, one.at) for one in self.exclusions.values())

    @property
    def solved(self) -> Adjustment:
        """The solution; raises SurveyError where there is none yet."""
        if self.adjustment is None:
            raise SurveyError(f"{self.project.folder}: is not adjusted yet; adjust it first")
        return self.adjustment


@dataclass(frozen=True)
class Step:
    """A decision that can be taken back: rows of exclusions.csv, and survey.toml before and after ("" as it was)."""

    label: str
    excluded: tuple[Exclusion, ...] = ()
    included: tuple[Exclusion, ...] = ()
    before: str = ""
    after: str = ""

    def reversed(self) -> "Step":
        """What takes it back."""
        return Step(self.label, self.included, self.excluded, self.after, self.before)


@dataclass(eq=False)
class _Values:
    """Start values of everything that was ever solved, and the models of the lenses they belong to."""

    start: StartValues = field(default_factory=lambda: StartValues({}, {}, {}, {}))
    models: dict[str, str] = field(default_factory=dict)

    def keep(self, adjustment: Adjustment) -> None:
        """Newer values go before older ones."""
        new, old = values_of(adjustment), self.start
        self.start = StartValues({**old.lenses, **new.lenses}, {**old.poses, **new.poses},
                                 {**old.points, **new.points}, {**old.vectors, **new.vectors})  # fmt: skip
        self.models |= {c.camera_id: c.lens.model for c in adjustment.survey.cameras}

    def begin(self, survey: Survey) -> StartValues | None:
        """Start values of a survey; None where the search has to begin anew, as it must for a free datum.

        Inner constraints keep the mean place of where the search began.
        """
        known = all(self.models.get(c.camera_id) == c.lens.model for c in survey.cameras)
        if not known or survey.datum.kind == "inner" or survey.pair_form == "closed":
            return None
        if any(len(self.start.lenses[c.camera_id]) != len(MODELS[c.lens.model].names) for c in survey.cameras):
            return None
        return self.start


class Workbench:
    """A project folder, kept in memory; see the module. Every method may be called from any thread.

    read_only: nothing is ever written. watch: called with (iteration, v'Pv) while something is adjusted.
    """

    def __init__(self, folder: str | Path, *, read_only: bool = False, watch: _Watch | None = None) -> None:
        self.folder, self.read_only, self.watch = Path(folder), read_only, watch
        self.version, self.n_unsaved = 0, 0
        self.changes: Changes | None = None
        self._done: list[Step] = []
        self._undone: list[Step] = []
        self._values, self._lock, self._cancel = _Values(), threading.RLock(), threading.Event()
        self._statistics: tuple[int, Statistics] | None = None
        self._rows: tuple[int, PointRows] | None = None
        self.situation = self._read()

    def _read(self) -> Situation:
        signature = signature_of(self.folder)  # first: what changes while it is read shows as changed afterwards
        everything = read_all(self.folder)
        text = decode(self.folder / DEFINITION_FILE, read_bytes(self.folder / DEFINITION_FILE)[0])
        exclusions = in_force(read_exclusions(self.folder / OBSERVATIONS_FOLDER)[0])
        return Situation(everything, leaving_out(everything, exclusions.values()), text, exclusions, signature)

    # what is there

    @property
    def adjustment(self) -> Adjustment:
        """The solution; raises SurveyError where there is none yet."""
        return self.situation.solved

    @property
    def scale(self) -> Scale:
        """What covariances of unknowns are multiplied with."""
        return scale_of(self.adjustment, self.situation.project.options.sigmas)

    @property
    def undoable(self) -> tuple[str, ...]:
        """What can be undone, the last decision first."""
        return tuple(s.label for s in reversed(self._done))

    @property
    def redoable(self) -> tuple[str, ...]:
        """What was undone and can be done again, the next first."""
        return tuple(s.label for s in reversed(self._undone))

    @property
    def rows(self) -> PointRows:
        """All image points with the solution."""
        with self._lock:
            if self._rows is None or self._rows[0] != self.version:
                now = self.situation
                self._rows = self.version, point_rows(now.survey, now.now, now.adjustment)
            return self._rows[1]

    @property
    def statistics(self) -> Statistics:
        """Reliability, correlations, budgets and so on, computed when first asked for. Raises SurveyError."""
        with self._lock:
            if self._statistics is None or self._statistics[0] != self.version:
                options = self.situation.project.options
                self._statistics = self.version, statistics_of(self.adjustment, options.tolerances, self.scale)
            return self._statistics[1]

    def spot_name(self, row: int) -> str:
        """The name under which a spot that has got a name is left out, by its row; raises IndexError for others."""
        at, there = row, self.situation.everything
        at -= sum(len(b.uv) for b in there.survey.image_blocks)
        for block in self.situation.identified:
            if 0 <= at < len(block.uv):
                place, z = (block.camera_id, block.epoch_id), complex(*block.uv[at].tolist())
                return next(f"spot:{'/'.join(place)}/{name}" for s in there.spots for name, spot in
                            zip(s.spot_ids, _complex(s.uv), strict=True)
                            if (s.camera_id, s.epoch_id) == place and spot == z)  # fmt: skip
            at -= len(block.uv)
        raise IndexError(row)

    def changed_files(self) -> tuple[str, ...]:
        """Files of the project that were written since they were read, by path in the folder."""
        now, before = signature_of(self.folder), self.situation.signature
        return tuple(sorted(name for name in {*now, *before} if now.get(name) != before.get(name)))

    def holder(self) -> str | None:
        """Who writes the folder at the moment."""
        return holder_of(self.folder / LOCK)

    # adjusting

    def adjust(self, mode: Mode = "warm") -> Changes | None:
        """Adjust what is in memory; what that changed, None the first time. Raises SurveyError, CancelledError."""
        with self._lock:
            return self._take(self._solved(self.situation, mode))

    def reload(self) -> Changes | None:
        """Read the folder again and adjust it; decisions made before can not be undone any more."""
        with self._lock:
            changes = self._take(self._solved(self._read(), "warm"))
            self._done, self._undone = [], []
            return changes

    def cancel(self) -> None:
        """Give up the adjustment that runs, at its next step."""
        self._cancel.set()

    def _take(self, new: Situation) -> Changes | None:
        before, self.situation = self.situation.adjustment, new
        self._values.keep(new.solved)
        self.version += 1
        self.changes = None if before is None else solution_changes(snapshot(before), snapshot(new.solved))
        return self.changes

    def _solved(self, situation: Situation, mode: Mode) -> Situation:
        self._cancel.clear()
        begin_s = perf_counter()
        found, how = self._adjusted(situation, mode)
        known = situation.known_spots
        identified = situation.identified
        if found is None:
            project = situation.project
            adjustment, how = adjust_project(project, False, watch=self._step), "cold"
            identified, known = _identified(situation.everything, adjustment), spot_places(project.spots)
        else:
            adjustment = found
        return replace(situation, adjustment=adjustment, identified=identified, known_spots=known, mode=how,
                       seconds=perf_counter() - begin_s)  # fmt: skip

    def _adjusted(self, situation: Situation, mode: Mode) -> tuple[Adjustment | None, Mode]:
        """From the values of before; None where that does not do."""
        project = situation.project
        if mode == "cold" or self.version == 0 or not spot_places(project.spots) <= situation.known_spots:
            return None, "cold"
        survey = situation.now
        named = tuple(_used_only(b) for b in survey.image_blocks[len(project.survey.image_blocks) :])
        blocks = (*project.survey.image_blocks, *(b for b in named if len(b.uv)))
        survey = replace(project.survey, image_blocks=blocks)
        survey = seen_points(survey) if project.spots else survey
        begun: list[bool] = []

        def begin(part: Survey) -> StartValues | None:
            start = self._values.begin(part)
            begun.append(start is not None)
            return start

        try:
            found = adjust_project(replace(project, survey=survey, spots=()), False, begin, watch=self._step)
        except CancelledError:
            raise
        except SurveyError:  # the values of before may be far from what is asked for now
            return None, "cold"
        return found, "warm" if all(begun) else "cold"

    def _step(self, iteration: int, omega: float) -> None:
        if self._cancel.is_set():
            raise CancelledError(f"{self.folder}: the adjustment was cancelled; the solution of before stays")
        if self.watch is not None:
            self.watch(iteration, omega)

    # deciding

    def preview(self, *names: str, excluded: bool = True) -> dict[str, Any]:
        """What leaving ``names`` out (or taking them back) means, before it is done. Raises SurveyError."""
        now = self.situation
        observed = Observed(now.everything.survey, now.everything.spots)
        found = [self._name(observed, name) for name in names]
        hits = union(observed.hits(name, observed.place_of(name)) for name in found)
        gone = leaving_out(now.everything, [*now.exclusions.values(), *(Exclusion(n) for n in found)]) \
            if excluded else now.project  # fmt: skip
        images = {(b.camera_id, b.epoch_id) for b in now.project.survey.image_blocks if _n_used(b)}
        kept = {(b.camera_id, b.epoch_id) for b in gone.survey.image_blocks if _n_used(b)}
        epochs = {e for _, e in images} - {e for _, e in kept}
        return {
            "names": [str(n) for n in found], "text": hits.text(), "n_image_points": hits.n_image_points,
            "n_readings": hits.n_readings, "n_spots": hits.n_spots, "n_images": len(hits.images),
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
        self, *, exclude: Sequence[str] = (), include: Sequence[str] = (), definition: str = "", reason: str = "",
        author: str = "", base: int | None = None, label: str = "",
    ) -> Changes | None:  # fmt: skip
        """Exclusions, inclusions and a new text of survey.toml as one decision; as :meth:`exclude`."""
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
            return self._decided(rows, definition, label)

    def _decided(self, rows: Sequence[Row], definition: str, label: str) -> Changes | None:
        now = self.situation
        step = Step(
            label, tuple(r.exclusion for r in rows if r.excluded),
            tuple(now.exclusions[r.exclusion.name] for r in rows if not r.excluded),
            now.definition_text if definition else "", definition,
        )  # fmt: skip
        changes = self._apply(step, rows)
        self._done.append(step)
        self._undone = []
        return changes

    def set_sigma_scale(self, group: str, factor: float, base: int | None = None) -> Changes | None:
        """Multiply all sigmas of a group, in survey.toml; otherwise as :meth:`exclude`."""
        text = with_sigma_scale(self.situation.definition_text, group, factor)
        return self.decide(definition=text, label=f"sigmas of {group} times {factor:g}", base=base)

    def set_treatment(self, name: str, treatment: str, base: int | None = None) -> Changes | None:
        """Make a parameter free, or hold it at its adjusted value, in survey.toml; otherwise as :meth:`exclude`.

        name: as in results: ``lens/X/k1``, ``point/B07``, ``station_from_camera/X``.
        """
        now = self.situation
        text = with_treatment(now.definition_text, now.project.survey, self.adjustment.estimates, name, treatment)
        return self.decide(definition=text, label=f"{name} {treatment}", base=base)

    def set_datum(
        self, kind: str, points: Sequence[str] = (), stations: Sequence[str] = (), base: int | None = None
    ) -> Changes | None:
        """Choose the datum, in survey.toml: ``given``, or ``inner`` over points and stations."""
        text = with_datum(self.situation.definition_text, kind, points, stations)
        return self.decide(definition=text, label=f"datum {kind}", base=base)

    def restore(self, number: int, base: int | None = None) -> tuple[str, ...]:
        """survey.toml and exclusions as they were at a run, as one decision; what else has changed since, for people.

        Raises as :meth:`exclude`, and where there is no such run.
        """
        with self._lock:
            self._check(base)
            run, text, now = find_run(self.folder, number), definition_of(self.folder, number), self.situation
            then = {e.name: e for e in run.exclusions}
            who = author_name(now.project.options.identification)
            why = f"run {number}"
            rows = [Row(True, replace(e, line=0)) for name, e in then.items() if name not in now.exclusions]
            rows += [Row(False, replace(e, reason=why, author=who)) for n, e in now.exclusions.items() if n not in then]
            definition = text if text != now.definition_text else ""
            if rows or definition:
                self._decided(rows, definition, f"restore run {number}")
            inputs = self.situation.everything.inputs
            other = sorted(k for k in {*inputs, *run.hashes} if inputs.get(k) != run.hashes.get(k))
            known = {DEFINITION_FILE, FILE}
            return tuple(f"{name}: is not as it was at run {number}; it stays as it is" for name in other
                         if name not in known)  # fmt: skip

    def compare(self, a: int | None = None, b: int | None = None) -> Changes:
        """From run ``a`` to run ``b``, every parameter in sigmas of ``a``; None: the solution in memory."""
        return solution_changes(self._snapshot(a), self._snapshot(b))

    def _snapshot(self, number: int | None) -> Snapshot:
        return snapshot(self.adjustment) if number is None else load_run(self.folder, number)

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
            changes = self._apply(effect, rows)
            onto.append(source.pop())
            return changes

    def _check(self, base: int | None) -> None:
        if self.read_only:
            raise SurveyError(f"{self.folder}: is open for reading only; open it without --read-only to change it")
        if base is not None and base != self.version:
            raise ChangedError(f"the solution has changed since (now {self.version}, not {base}); look at it again")
        self._require_unchanged()

    def _require_unchanged(self) -> None:
        changed = self.changed_files()
        if changed:
            raise ChangedError(f"{self.folder}: {', '.join(changed)} changed meanwhile; load the project again")

    def _apply(self, step: Step, rows: Sequence[Row]) -> Changes | None:
        """Solve first, then write, then take: what cannot be solved is not recorded."""
        now, text = self.situation, step.after
        if step.before and step.before != now.definition_text:
            raise ChangedError(f"{self.folder / DEFINITION_FILE}: has changed since; undo cannot put it back")
        everything = read_all(self.folder, text) if text else now.everything
        exclusions = dict(now.exclusions)
        for row in rows:
            exclusions.pop(row.exclusion.name, None)
            if row.excluded:
                exclusions[row.exclusion.name] = row.exclusion
        trial = replace(
            now, everything=everything, project=leaving_out(everything, exclusions.values()), exclusions=exclusions,
            definition_text=text or now.definition_text,
        )  # fmt: skip
        if text:  # which spot is which beacon may be another question now
            trial = replace(trial, identified=(), known_spots=frozenset())
        solved = self._solved(trial, "warm")
        signature = self._write(text, rows)
        changes = self._take(replace(self._as_written(solved), signature=signature))
        self.n_unsaved += 1
        return changes

    def _write(self, text: str, rows: Sequence[Row]) -> Mapping[str, tuple[int, int]]:
        """Write what was decided; the signature of the files then, taken while nobody else may write."""
        with changing(self.folder, inputs=True) as place:
            self._require_unchanged()
            if text:
                atomic_write(place / DEFINITION_FILE, text)
            if rows:
                atomic_write(place / FILE, appended(self.folder / FILE, rows))
            replace_parts(self.folder)
            return signature_of(self.folder)

    def _as_written(self, situation: Situation) -> Situation:
        """With the hashes of the files as they are now, and the lines on which exclusions stand."""
        rows, digest = read_exclusions(self.folder / OBSERVATIONS_FOLDER)
        exclusions = in_force(rows)
        inputs = {**situation.everything.inputs, **({FILE: digest} if digest else {})}
        everything = replace(situation.everything, inputs=dict(sorted(inputs.items())))
        project = leaving_out(everything, exclusions.values())
        return replace(situation, everything=everything, project=project, exclusions=exclusions)

    def _name(self, observed: Observed, text: str) -> Name:
        for name in self.situation.exclusions:
            if str(name) == text:
                return name
        return observed.find(text)

    def save(self) -> AdjustOutcome:
        """Write ``results`` as ``labsurvey adjust`` does, and a run beside the others. Raises as :meth:`exclude`."""
        with self._lock:
            self._check(None)
            clock = Clock({"adjust": self.situation.seconds})
            with changing(self.folder) as place:
                self._require_unchanged()
                said = command_line("open", self.folder)
                outcome = made(self.situation.project, self.adjustment, place, clock, command=said)
                gone = kept_run(self.folder, place, self.situation.project, outcome)
                replace_parts(self.folder, gone=gone)
            remove_empty(self.folder, gone)
            self.n_unsaved = 0
            return outcome.at(self.folder)

    def run(self) -> Any:
        """What was run, for reports."""
        return run_info(self.situation.project, {})


def signature_of(folder: Path) -> dict[str, tuple[int, int]]:
    """Time (ns) and size of everything that a project is read from, by path; images by the folders they lie in."""
    out: dict[str, tuple[int, int]] = {}
    images = [p for p in (folder / "images").glob("*") if p.is_dir()] if (folder / "images").is_dir() else []
    tables = [p for p in (folder / OBSERVATIONS_FOLDER).glob("*") if p.suffix in (".csv", ".parquet")]
    for path in (folder / DEFINITION_FILE, *tables, *images):
        try:
            status = path.stat()
        except OSError:
            continue
        out[path.relative_to(folder).as_posix()] = status.st_mtime_ns, 0 if path.is_dir() else status.st_size
    return out


def spot_places(spots: Iterable[SpotBlock]) -> frozenset[tuple[str, str, complex]]:
    """Spots by camera, epoch and u + iv (px)."""
    return frozenset((s.camera_id, s.epoch_id, z) for s in spots for z in _complex(s.uv))


def _complex(uv: FloatArray) -> list[complex]:
    return [complex(u, v) for u, v in uv.tolist()]


def _n_used(block: ImageBlock) -> int:
    return len(block.uv) if block.used is None else int(block.used.sum())


def _used_only(block: ImageBlock) -> ImageBlock:
    rows = np.arange(len(block.uv)) if block.used is None else np.flatnonzero(block.used)
    return replace(block, point_idx=block.point_idx[rows], uv=block.uv[rows], cov=block.cov[rows], used=None)


def _identified(everything: Project, adjustment: Adjustment) -> tuple[ImageBlock, ...]:
    """The spots that the adjustment found a name for, as blocks over all points of the project."""
    spots = spot_places(everything.spots)
    index = {p.point_id: i for i, p in enumerate(everything.survey.points)}
    names = [p.point_id for p in adjustment.survey.points]
    out = []
    for block in adjustment.survey.image_blocks if spots else ():
        places = ((block.camera_id, block.epoch_id, z) for z in _complex(block.uv))
        if block.target_id is None and all(place in spots for place in places):
            idx = np.array([index[names[int(i)]] for i in block.point_idx], dtype=np.int64)
            out.append(replace(block, point_idx=idx, used=None))
    return tuple(out)


def positions(adjustment: Adjustment) -> dict[str, FloatArray]:
    """Adjusted points (3,) m by id."""
    found = {n[1]: e.value for n, e in adjustment.estimates.items() if n[0] == "point"}
    return {p: np.asarray(x) for p, x in found.items() if not isinstance(x, Pose3)}
