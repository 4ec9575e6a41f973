"""Spots that are no known beacon because the coordinates stand in other axes, in another unit or in another frame."""

from collections.abc import Iterable
from dataclasses import replace

from adjust.adjustment import adjust
from adjust.diagnosis.case import Case
from adjust.diagnosis.diagnosis import diagnose
from adjust.diagnosis.hypothesis import ChangeColumns, Hypothesis, Place
from adjust.diagnosis.images import MIRRORED, mapped
from adjust.diagnosis.units.axes import other_axes
from adjust.model.errors import DiagnosedError, SurveyError
from adjust.model.result import Adjustment
from adjust.model.survey import Survey
from adjust.statistics.outliers.supported import supported
from survey.jobs.adjusting.edits import OF_IMAGE
from survey.jobs.adjusting.frame_of_coordinates import in_other_frames
from survey.jobs.adjusting.mirrored_survey import sides
from survey.jobs.adjusting.places import located
from survey.jobs.adjusting.probable_causes import causes_first
from survey.jobs.identify import Identification, identified, identify_spots, spot_views, without_points
from survey.project import Project

_BOTTOM = MIRRORED[1]
_TIMES, _MORE = 2, 4
"""How many times as many spots have to get a name, and how many more, for a change of coordinates to be tried."""


def require_names(project: Project, first: Adjustment, found: Identification, gate_px: float) -> None:
    """For spots most of which have no name. Raises DiagnosedError where a change gives them names, and fits.

    first: of the cameras and stations, without the spots. found: the names by the coordinates as they stand.
    """

    def named(hypotheses: Iterable[Hypothesis]) -> list[Hypothesis]:
        """Those that name most spots, if these are many more."""
        changed = [(h, survey) for h in hypotheses if (survey := h.changed()) is not None]
        again = [(h, survey, identify_spots(survey, views, gate_px)) for h, survey in changed]
        most = max((names.identified for *_, names in again), default=0)
        return [_told(h, survey, names, len(again), found.identified) for h, survey, names in again
                if names.identified == most >= enough]  # fmt: skip

    views = spot_views(project.survey, first, project.spots)
    enough = max(_TIMES * found.identified, found.identified + _MORE)
    best = (
        _mirrored(project, first, gate_px, enough, found.identified)
        or named(other_axes(project.survey)) or named(in_other_frames(project, first, gate_px))[:1]
    )  # fmt: skip
    diagnosis = diagnose(Case(identified(project.survey, found), None, SurveyError("")), [lambda _: best])
    if diagnosis.candidates:
        diagnosis = located(diagnosis, project)
        then = "mend that first: as it is, the spots have wrong names, or none"
        raise DiagnosedError(causes_first(diagnosis.lines, then), diagnosis)


def _mirrored(project: Project, first: Adjustment, gate_px: float, enough: int, before: int) -> list[Hypothesis]:
    """All image points mirrored back, if far more spots have names then."""
    seen = sides(project, first)
    if not seen.behind or seen.some_from_front:
        return []
    back, hypothesis = _mirrored_back(project)
    try:
        again = adjust(supported(without_points(back.survey, back.spots))[0])
    except SurveyError:
        return []
    names = identify_spots(back.survey, spot_views(back.survey, again, back.spots), gate_px)
    return [_told(hypothesis, back.survey, names, 1, before)] if names.identified >= enough else []


def _told(h: Hypothesis, survey: Survey, names: Identification, looked_at: int, before: int) -> Hypothesis:
    cause = f"{h.cause}: so read, {_share(names)} are one of the beacons, as they stand {before}"
    return replace(h, survey=identified(survey, names), looked_at=looked_at, cause=cause)


def _share(found: Identification) -> str:
    return f"{found.identified} of {found.identified + found.unidentified} spots"

def _mirrored_back(project: Project) -> tuple[Project, Hypothesis]:
    """The project with all image points and spots mirrored back, and that as a hypothesis."""
    survey, sizes = project.survey, {c.camera_id: c.image_size for c in project.survey.cameras}
    for camera in sizes:
        epochs = {b.epoch_id for b in survey.image_blocks if b.camera_id == camera}
        survey = mapped(survey, camera, epochs, _BOTTOM)
    spots = tuple(_BOTTOM.back(b, sizes[b.camera_id]) for b in project.spots)
    edits = [ChangeColumns("image_points", OF_IMAGE, _BOTTOM.matrix, _BOTTOM.offset(size), {"camera_id": (camera,)})
             for camera, size in sizes.items()]  # fmt: skip
    hypothesis = Hypothesis(
        "images mirrored",
        f"all image points are mirrored, {_BOTTOM.text}: they show the front of flat targets from behind",
        "count v_px from the top in image_points.csv and spots.csv, or mirror the images back and detect them again",
        Place("camera", tuple(sizes)), survey, tuple(edits),
    )  # fmt: skip
    return replace(project, survey=survey, spots=spots), hypothesis
