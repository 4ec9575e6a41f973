"""A project in memory that is adjusted again, and again, from the values of everything that was ever solved.

All that is known of it stands here; decisions, jobs and views are functions of it.
"""

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

from adjust.model.errors import DiagnosedError, SurveyError
from adjust.model.result import Adjustment
from adjust.model.survey import Survey
from survey.folder.locking import LOCK, holder_of
from survey.folder.plain import differing
from survey.folder.text import read_text
from survey.project.project import DEFINITION_FILE, Project
from survey.project.reading import leaving_out, read_all, with_exclusions
from survey.solution.earlier.changes import Changes, solution_changes
from survey.solution.quantities import Scale, scale_of
from survey.workbench.kept import Kept, kept_results, with_kept
from survey.workbench.pages.beginning import Folder
from survey.workbench.rows import PointRows, point_rows
from survey.workbench.situation import (
    CancelledError,
    ChangedError,
    KnownValues,
    Mode,
    Situation,
    Step,
    identified_in,
    judgement_of,
    signature_of,
    spot_places,
)

if TYPE_CHECKING:  # what adjusts comes when something is adjusted: the first view is there before
    from adjust.diagnosis.diagnosis import Candidate, Diagnosis
    from adjust.graph.assembly import StartValues
    from survey.solution.statistics import Statistics

Watch = Callable[[int, float], None]
_UNREAD = object()
_MOST_KEPT = 300_000  # image points: of more only the verdict is taken from the results, to be there at once


class Resident(Folder):
    """A project folder, kept in memory, with what was decided about it. Every method may be called from any thread.

    folder: or a project that was read, whose folder is meant: what is decided is written there. read_only: nothing is
    ever written. watch: called with (iteration, v'Pv) while something is adjusted. lock: of who changes anything.
    done, undone: decisions, and those that were taken back, the last behind.
    """

    def __init__(
        self, folder: str | Path | Project, *, read_only: bool = False, watch: Watch | None = None
    ) -> None:  # fmt: skip
        super().__init__(folder.folder if isinstance(folder, Project) else folder, read_only)
        self.watch, self.version, self.n_unsaved = watch, 0, 0
        self.done, self.undone = list[Step](), list[Step]()
        self.layout = 0  # counts changes of which image points there are, and in which order
        self.changes: Changes | None = None
        self.failure: SurveyError | None = None
        self._values, self.lock, self._cancel = KnownValues(), threading.RLock(), threading.Event()
        self._joining = threading.Lock()
        self._statistics: tuple[int, Statistics] | None = None
        self._rows: tuple[Situation, PointRows] | None = None
        self._kept: object = _UNREAD
        self.situation = self._read()

    def _read(self) -> Situation:
        signature = signature_of(self.folder)  # first: what changes while it is read shows as changed afterwards
        everything, exclusions = with_exclusions(read_all(self.folder), self.folder)
        text = read_text(self.folder / DEFINITION_FILE)
        return Situation(everything, leaving_out(everything, exclusions.values()), text, exclusions, signature)

    # what is there

    @property
    def adjustment(self) -> Adjustment:
        """The solution; raises SurveyError where there is none yet."""
        return self.situation.solved.adjustment

    @property
    def scale(self) -> Scale:
        """What covariances of unknowns are multiplied with."""
        return scale_of(self.adjustment, self.situation.project.options.sigmas)

    @property
    def rows(self) -> PointRows:
        """All image points with the solution, also while the next one is adjusted."""
        with self._joining:
            kept, now = self._rows, self.situation
            if kept is None or kept[0] is not now:
                made = point_rows(now.survey, now.now, now.adjustment)
                kept = now, made if self.kept is None or len(made.test) > _MOST_KEPT else with_kept(made, now)
                self._rows = kept
            return kept[1]

    @property
    def kept(self) -> Kept | None:
        """What the results in the folder say, until there is a solution."""
        if self.version or self.failure is not None:
            return None
        if self._kept is _UNREAD:
            self._kept = kept_results(self.situation)
        return self._kept if isinstance(self._kept, Kept) else None

    @property
    def statistics(self) -> "Statistics":
        """Reliability, correlations, budgets and so on, computed when first asked for. Raises SurveyError."""
        from survey.solution.statistics import statistics_of

        with self.lock:
            if self._statistics is None or self._statistics[0] != self.version:
                found, options = self.situation.solved, self.situation.project.options
                made = statistics_of(found.adjustment, options, self.scale, found.tested)
                self._statistics = self.version, made
            return self._statistics[1]

    def changed_files(self) -> tuple[str, ...]:
        """Files of the project that were written since they were read, by path in the folder."""
        return tuple(differing(signature_of(self.folder), self.situation.signature))

    def check(self, base: int | None = None) -> None:
        """Raise SurveyError where nothing may be written, or what is decided about solution ``base`` is out of date."""
        self.require_writable()
        if base is not None and base != self.version:
            raise ChangedError(f"the solution has changed since (now {self.version}, not {base}); look at it again")
        self.require_unchanged()

    def require_unchanged(self) -> None:
        """Raise ChangedError where others wrote files of the project."""
        changed = self.changed_files()
        if changed:
            raise ChangedError(f"{self.folder}: {', '.join(changed)} changed meanwhile; load the project again")

    def holder(self) -> str | None:
        """Who writes the folder at the moment."""
        return holder_of(self.folder / LOCK)

    # adjusting

    def adjust(self, mode: Mode = "warm") -> Changes | None:
        """Adjust what is in memory; what that changed, None the first time. Raises SurveyError, CancelledError."""
        with self.lock:
            try:
                return self.take(self.solved(self.situation, mode))
            except CancelledError:
                raise
            except SurveyError as error:
                self.failure = error
                raise

    def reload(self) -> Changes | None:
        """Read the folder again and adjust it, where there is anything to adjust; nothing can be undone any more."""
        with self.lock:
            new = self._read()
            still_empty = new.everything.is_empty and self.situation.adjustment is None
            changes = self.take(new if still_empty else self.solved(new, "warm"))
            self.done, self.undone = [], []
            return changes

    @property
    def diagnosis(self) -> "Diagnosis | None":
        """What is wrong, of the last solution; where there is none yet, of the adjustment that failed."""
        found = self.failure.diagnosis if isinstance(self.failure, DiagnosedError) else None
        if self.situation.adjustment is not None:
            found = self.situation.adjustment.diagnosis
        if found is None:
            return None
        from adjust.diagnosis.diagnosis import Diagnosis

        return found if isinstance(found, Diagnosis) else None

    @property
    def undoable(self) -> tuple[str, ...]:
        """What can be undone, the last decision first."""
        return tuple(s.label for s in reversed(self.done))

    @property
    def redoable(self) -> tuple[str, ...]:
        """What was undone and can be done again, the next first."""
        return tuple(s.label for s in reversed(self.undone))

    @property
    def remedies(self) -> "tuple[Candidate, ...]":
        """What the diagnosis of the last adjustment, failed or not, says would mend it, the best first."""
        return () if self.diagnosis is None else self.diagnosis.candidates

    def cancel(self) -> None:
        """Give up the adjustment that runs, at its next step."""
        self._cancel.set()

    def take(self, new: Situation, failure: SurveyError | None = None) -> Changes | None:
        """What is new from now on; what that changed."""
        old, before, after = self.situation, self.situation.judgement, new.judgement
        same = new.everything.survey is old.everything.survey and new.identified is old.identified
        self.layout += not same
        self.situation = new
        self.version, self.failure, self.changes = self.version + 1, failure, None
        if after is not None:
            self._values.keep(after.adjustment)
            self.changes = None if before is None else solution_changes(before.snapshot, after.snapshot)
        return self.changes

    def solved(self, situation: Situation, mode: Mode) -> Situation:
        """Adjusted; raises SurveyError, CancelledError."""
        self._cancel.clear()
        begin_s = perf_counter()
        found, how = self._adjusted(situation, mode)
        known = situation.known_spots
        identified = situation.identified
        if found is None:
            project = situation.project
            from survey.jobs.adjusting.steps import adjust_project

            adjustment, how = adjust_project(project, False, watch=self._step), "cold"
            identified, known = identified_in(situation.everything, adjustment), spot_places(project.spots)
        else:
            adjustment = found
        return replace(
            situation, judgement=judgement_of(adjustment, situation.project), identified=identified,
            known_spots=known, mode=how, seconds=perf_counter() - begin_s,
        )  # fmt: skip

    def _adjusted(self, situation: Situation, mode: Mode) -> tuple[Adjustment | None, Mode]:
        """From the values of before; None where that does not do."""
        project = situation.project
        if mode == "cold" or self.version == 0 or not spot_places(project.spots) <= situation.known_spots:
            return None, "cold"
        from survey.jobs.adjusting.steps import adjust_project
        from survey.jobs.identify import seen_points

        survey = situation.now
        named = tuple(b.in_use() for b in survey.image_blocks[len(project.survey.image_blocks) :])
        blocks = (*project.survey.image_blocks, *(b for b in named if len(b.uv)))
        survey = replace(project.survey, image_blocks=blocks)
        survey = seen_points(survey) if project.spots else survey
        begun: list[bool] = []

        def begin(part: Survey) -> "StartValues | None":
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
