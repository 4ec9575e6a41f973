"""From a project and its plan to a survey with predicted observations, its values, and candidates."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from adjust.design import Candidate, predict, with_candidates
from adjust.graph.assembly import StartValues
from adjust.model.errors import SurveyError, listed
from adjust.model.frozen import frozen
from adjust.model.observations import ImageBlock, PositionRef, TableReading
from adjust.model.result import Adjustment
from adjust.model.survey import IntArray, Point, PointParameter, Station, Survey
from survey.planning.plan_file import Moment, NewPoint, Plan
from survey.planning.plan_readings import coordinates_at, with_usual_sigmas
from survey.planning.values import PlannedValues, gathered, placed_moments
from survey.project import Project


@frozen(eq=False)
class Planned:
    """A survey of existing and planned observations, the values of everything, and what could be added.

    survey: without candidates. start: also has the values of what candidates bring. ideal image points are in
    ``survey.image_blocks``. notes: for people.
    """

    survey: Survey
    start: StartValues
    candidates: tuple[Candidate, ...]
    n_existing_blocks: int
    n_planned_epochs: int
    notes: tuple[str, ...]


def build_plan(project: Project, plan: Plan, existing: Adjustment | None, notes: Sequence[str] = ()) -> Planned:
    """Predict everything planned. existing: adjustment of what is observed already, whose values then count.

    Raises SurveyError where a value or a sigma is missing.
    """
    base = existing.survey if existing is not None else project.survey
    values = gathered(base, existing)
    taken = {b.epoch_id for b in base.image_blocks} | {r.epoch_id for r in base.table_readings}
    taken |= {epoch for _, epoch in project.images}
    said = list(notes)
    planned = placed_moments(plan.planned.epochs, base, values)
    possible = placed_moments(plan.candidates.epochs, base, values)
    _check_new(plan, taken, planned + possible)
    _check_moving(base, planned + possible)
    readings = tuple(r for m in planned + possible for r in _readings(m, project))
    everything = replace(base, table_readings=base.table_readings + readings)
    start = _with_moving(values, planned + possible).start()
    seen = _seen(everything, start, planned, plan, project)
    dark = [m.epoch_id for m in planned if not any(b.epoch_id == m.epoch_id for b in seen)]
    if dark:
        said.append(f"planned epochs that show nothing, left out: {listed(dark, 8)}")
    lit = [m for m in planned if m.epoch_id not in dark]
    whole = replace(
        base,
        image_blocks=base.image_blocks + seen,
        table_readings=base.table_readings + tuple(r for m in lit for r in _readings(m, project)),
    )
    extra = {p.name: p.x_in_world for p in plan.candidates.points}
    start = replace(start, points={**start.points, **extra})
    whole = with_candidates(whole, with_usual_sigmas(plan.planned.singles, whole, start, project))
    candidates, blind = _candidates(whole, everything, start, possible, plan, project, lit)
    if blind:
        said.append(f"candidates that show nothing, left out: {listed(blind, 8)}")
    return Planned(whole, start, candidates, len(base.image_blocks), len(lit), tuple(said))


def _check_new(plan: Plan, taken: set[str], moments: Sequence[Moment]) -> None:
    seen: set[str] = set()
    for m in moments:
        if m.epoch_id in taken or m.epoch_id in seen:
            raise SurveyError(f"{plan.path}: epoch {m.epoch_id!r} is there already; give the series another name")
        seen.add(m.epoch_id)


def _check_moving(survey: Survey, moments: Sequence[Moment]) -> None:
    """Raise where a fixed station or target is given poses."""
    for m in moments:
        if m.station_id is not None and survey.stations_by_id[m.station_id].motion == "fixed":
            raise SurveyError(f'station {m.station_id} is given poses but is fixed; write motion = "epoch" or "table"')
        if m.target_id is not None and survey.targets_by_id[m.target_id].motion == "fixed":
            raise SurveyError(f'target {m.target_id} is given poses but is fixed; write motion = "epoch"')


def _with_moving(values: PlannedValues, moments: Sequence[Moment]) -> PlannedValues:
    for m in moments:
        if m.pose is not None:
            name = ("world_from_station", m.station_id) if m.station_id else ("carrier_from_target", str(m.target_id))
            values.poses[(*name, m.epoch_id)] = m.pose
        if m.angles is not None:
            values.vectors["table_angles", str(m.table_id), m.epoch_id] = m.angles
    return values


def _readings(m: Moment, project: Project) -> list[TableReading]:
    if m.table_id is None or m.angles is None:
        return []
    sigma = project.sigmas.tables.get(m.table_id)
    if sigma is None:
        raise SurveyError(f"{project.folder}/survey.toml: table {m.table_id} has no sigma_arcsec; planning needs it")
    scale = project.sigmas.scale.get("table", 1.0)
    return [TableReading(m.table_id, m.epoch_id, m.angles, np.diag((scale * sigma) ** 2))]


def _sigma_px(plan: Plan, project: Project) -> float:
    sigma = plan.image_sigma_px if plan.image_sigma_px is not None else project.sigmas.image_px
    if sigma is None:
        raise SurveyError(f"{plan.path}: no sigma of image points; give image_sigma_px here or [sigmas] image_px")
    return sigma * project.sigmas.scale.get("image", 1.0)


def _wanted(survey: Survey, m: Moment, sigma: float, points: Sequence[int]) -> list[ImageBlock]:
    """Every block that the images of an epoch may show: all points, seen or not."""
    out = []
    posed = {s.station_id for s in survey.stations if _is_posed(s, m)}
    hung = {
        t.target_id
        for t in survey.targets
        if (t.motion == "fixed" or m.target_id == t.target_id) and (t.station_id is None or t.station_id in posed)
    }
    for camera in (c for c in m.cameras if survey.cameras_by_id[c].station_id in posed):
        for target in (t for t in m.targets if t in hung):
            idx = np.arange(len(survey.targets_by_id[target].point_ids), dtype=np.int64)
            out.append(_block(camera, m.epoch_id, target, idx, sigma))
        if m.points and len(points):
            out.append(_block(camera, m.epoch_id, None, np.array(points, dtype=np.int64), sigma))
    return out


def _is_posed(station: Station, m: Moment) -> bool:
    """Whether it is known where a station is at an epoch; what nobody placed then takes no image."""
    if station.motion == "fixed" or m.station_id == station.station_id:
        return True
    return station.motion == "table" and m.table_id is not None and m.table_id == station.table_id


def _block(camera: str, epoch: str, target: str | None, idx: IntArray, sigma: float) -> ImageBlock:
    cov = np.tile(sigma**2 * np.eye(2), (len(idx), 1, 1))
    return ImageBlock(camera, epoch, target, idx, np.zeros((len(idx), 2)), cov)


def _seen(
    survey: Survey, start: StartValues, moments: Sequence[Moment], plan: Plan, project: Project
) -> tuple[ImageBlock, ...]:
    sigma = _sigma_px(plan, project) if moments else 1.0
    located = [i for i, p in enumerate(survey.points)
               if p.point_id in start.points or p.x_in_world.treatment == "held"]  # fmt: skip
    wanted = [b for m in moments for b in _wanted(survey, m, sigma, located)]
    if len(located) < len(survey.points):
        lost = [p.point_id for i, p in enumerate(survey.points) if i not in located]
        raise SurveyError(f"{plan.path}: points without coordinates: {listed(lost, 8)}; give x_mm, roughly will do; "
                          "planning needs a value in survey.toml for everything")  # fmt: skip
    try:
        return predict(survey, start, wanted, plan.seeing)
    except SurveyError as error:
        raise SurveyError(f"{plan.path}: {error}; planning needs a value in survey.toml for everything") from error


def _candidates(
    whole: Survey, everything: Survey, start: StartValues, possible: Sequence[Moment], plan: Plan, project: Project,
    planned: Sequence[Moment],
) -> tuple[tuple[Candidate, ...], list[str]]:  # fmt: skip
    out, blind = [], []
    blocks = _seen(everything, start, possible, plan, project)
    for m in possible:
        own = tuple(b for b in blocks if b.epoch_id == m.epoch_id)
        if not own:
            blind.append(m.epoch_id)
            continue
        out.append(Candidate(_epoch_text(m), "epoch", own, tuple(_readings(m, project))))
    for new in plan.candidates.points:
        found = _new_beacon(whole, start, new, plan, project, planned)
        out += [found] if found is not None else []
        blind += [new.name] if found is None else []
    return (*out, *with_usual_sigmas(plan.candidates.singles, whole, start, project)), blind


def _epoch_text(m: Moment) -> str:
    if m.angles is None:
        return m.epoch_id
    return f"{m.epoch_id} ({', '.join(f'{a:g}' for a in np.round(np.degrees(m.angles), 6))} deg)"


def _new_beacon(
    whole: Survey, start: StartValues, new: NewPoint, plan: Plan, project: Project, planned: Sequence[Moment]
) -> Candidate | None:
    """A beacon seen in the planned images that show world points, or surveyed."""
    point, n = Point(new.name, PointParameter(new.x_in_world)), len(whole.points)
    sigma_px = _sigma_px(plan, project)
    blocks = tuple(
        _block(c, m.epoch_id, None, np.array([n]), sigma_px) for m in planned if m.points for c in m.cameras
    )
    one = Candidate(new.name, "beacon", blocks, points=(point,))
    seen = predict(with_candidates(whole, [one]), start, blocks, plan.seeing)
    surveyed = (coordinates_at(PositionRef(new.name), new.sigma),) if np.isfinite(new.sigma) else ()
    if not seen:
        return None
    return replace(one, image_blocks=seen, coordinates=surveyed)

