"""A project as it is read, with its solution, and the values from which the next adjustment begins."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from adjust.lenses.models import MODELS
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import ImageBlock
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, Survey
from survey.folder.plain import plain
from survey.jobs.excluding import FILE
from survey.project import Project
from survey.project.exclusions import Exclusion, Name
from survey.project.observed import Hits, Observed, union
from survey.project.project import DEFINITION_FILE, OBSERVATIONS_FOLDER, SpotBlock
from survey.solution.earlier.changes import Snapshot, in_short

if TYPE_CHECKING:
    from adjust.graph.assembly import StartValues
    from adjust.statistics.result import Consistency

Mode = Literal["warm", "cold"]


class ChangedError(SurveyError):
    """What a decision was based on is not what there is any more: a newer solution, or files that others wrote."""


class CancelledError(SurveyError):
    """The adjustment was given up because somebody asked for that."""


@frozen(eq=False)
class Judgement:
    """An adjustment, its summary with the verdict on every part, its warnings, and what was tested for them."""

    adjustment: Adjustment
    snapshot: Snapshot
    warnings: tuple[str, ...]
    tested: "Consistency"


def judgement_of(adjustment: Adjustment, project: Project) -> Judgement:
    """As the results would have it. Raises SurveyError for a tolerance that is about nothing."""
    from survey.solution.dictionary import summary_dict  # here: the page comes before what adjusts is loaded
    from survey.solution.quantities import scale_of
    from survey.solution.statistics import tested_parts
    from survey.solution.tolerances import verdicts
    from survey.solution.verdict import warnings_with

    scale, tested = scale_of(adjustment, project.options.sigmas), tested_parts(adjustment)
    n_unmet = sum(not v.met for v in verdicts(adjustment, project.options.tolerances, scale))
    summary = plain(in_short(summary_dict(adjustment, project.title, scale, tested, n_unmet)))
    return Judgement(adjustment, Snapshot(adjustment.estimates, summary), warnings_with(adjustment, tested), tested)


@frozen(eq=False)
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
    judgement: Judgement | None = None
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
        named = (replace(b, used=np.array([(b.camera_id, b.epoch_id, z) in there for z in in_complex(b.uv)]))
                 for b in self.identified)  # fmt: skip
        return replace(survey, image_blocks=(*survey.image_blocks, *named))

    @property
    def left(self) -> Hits:
        """What people left out."""
        observed = Observed(self.everything.survey, self.everything.spots)
        return union(observed.hits(one.name, one.at) for one in self.exclusions.values())

    @property
    def adjustment(self) -> Adjustment | None:
        """The solution, None where there is none yet."""
        return None if self.judgement is None else self.judgement.adjustment

    @property
    def solved(self) -> Judgement:
        """The solution, judged; raises SurveyError where there is none yet."""
        if self.judgement is None:
            raise SurveyError(f"{self.project.folder}: is not adjusted yet; adjust it first")
        return self.judgement

    def solved_as(self, known: "Situation") -> "Situation":
        """With the solution of another one that rests on the same."""
        return replace(
            self, judgement=known.judgement, identified=known.identified, known_spots=known.known_spots,
            mode=known.mode, seconds=known.seconds,
        )  # fmt: skip

    @property
    def basis(self) -> tuple[dict[str, str], set[tuple[Name, tuple[float, float] | None]]]:
        """What a solution rests on: hashes of the files that were read, and what people left out."""
        files = {name: digest for name, digest in self.everything.inputs.items() if name != FILE}
        return files, {(one.name, one.at) for one in self.exclusions.values()}


@frozen(eq=False)
class Step:
    """A decision that can be taken back: rows of exclusions.csv, and files (by path in the folder) before and after.

    cold: it is about what the values of before rest on, so that they are no good start. unsolved: there was no solution
    before it, and there may be none once it is taken back. beyond: what there is once it is taken back (or done again).
    """

    label: str
    excluded: tuple[Exclusion, ...] = ()
    included: tuple[Exclusion, ...] = ()
    before: Mapping[str, str] = field(default_factory=dict)
    after: Mapping[str, str] = field(default_factory=dict)
    cold: bool = False
    unsolved: bool = False
    beyond: Situation | None = None

    def reversed(self) -> "Step":
        """What takes it back."""
        return replace(self, excluded=self.included, included=self.excluded, before=self.after, after=self.before)


@dataclass(eq=False)
class KnownValues:
    """Start values of everything that was ever solved, and the models of the lenses they belong to."""

    start: "StartValues | None" = None
    models: dict[str, str] = field(default_factory=dict)

    def keep(self, adjustment: Adjustment) -> None:
        """Newer values go before older ones."""
        from adjust.graph.assembly import StartValues, values_of

        new, old = values_of(adjustment), self.start
        self.start = new if old is None else StartValues(
            {**old.lenses, **new.lenses}, {**old.poses, **new.poses}, {**old.points, **new.points},
            {**old.vectors, **new.vectors})  # fmt: skip
        self.models |= {c.camera_id: c.lens.model for c in adjustment.survey.cameras}

    def begin(self, survey: Survey) -> "StartValues | None":
        """Start values of a survey; None where the search has to begin anew, as it must for a free datum.

        Inner constraints keep the mean place of where the search began.
        """
        known = all(self.models.get(c.camera_id) == c.lens.model for c in survey.cameras)
        start = self.start
        if start is None or not known or survey.datum.kind == "inner" or survey.pair_form == "closed":
            return None
        if any(len(start.lenses[c.camera_id]) != len(MODELS[c.lens.model].names) for c in survey.cameras):
            return None
        return start


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
    return frozenset((s.camera_id, s.epoch_id, z) for s in spots for z in in_complex(s.uv))


def in_complex(uv: FloatArray) -> list[complex]:
    """Places (n, 2) px as u + iv."""
    return [complex(u, v) for u, v in uv.tolist()]


def identified_in(everything: Project, adjustment: Adjustment) -> tuple[ImageBlock, ...]:
    """The spots that the adjustment found a name for, as blocks over all points of the project."""
    spots = spot_places(everything.spots)
    index = {p.point_id: i for i, p in enumerate(everything.survey.points)}
    names = [p.point_id for p in adjustment.survey.points]
    out = []
    for block in adjustment.survey.image_blocks if spots else ():
        places = ((block.camera_id, block.epoch_id, z) for z in in_complex(block.uv))
        if block.target_id is None and all(place in spots for place in places):
            idx = np.array([index[names[int(i)]] for i in block.point_idx], dtype=np.int64)
            out.append(replace(block, point_idx=idx, used=None))
    return tuple(out)
