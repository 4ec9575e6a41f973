"""What a survey cannot give, told before it is adjusted: from its observations, single views and its start values.

Nothing is adjusted: sigmas are those that the observation equations have at the start values
(:func:`adjust.design.expectation.expect`).
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from adjust.adjustment import start_values
from adjust.design.expectation import expect, weak_directions
from adjust.diagnosis.case import Case
from adjust.diagnosis.units.conventions import LENGTH_RATIOS
from adjust.model.errors import IndeterminateError, SurveyError, listed
from adjust.model.observations import PositionRef
from adjust.model.result import Adjustment
from adjust.model.survey import Camera, FloatArray, Survey
from adjust.start import find_start
from adjust.statistics.outliers.supported import supported

_CELLS = (8, 6)
_COVERED, _SMALL_IMAGE = 0.5, 0.15
_NEAR_POINTS_PX = 12.0
_FLATTEST, _STEEPEST = np.radians(65.0), np.radians(10.0)
_FEW_VIEWS = 5
_WEAK = 1000.0
_ODD_SIGMA = 100.0


@dataclass(frozen=True)
class Finding:
    """One thing to mend or to measure. level: ``problem`` spoils or stops the adjustment, ``weak`` weakens it.

    kind: short and constant, for programs. ids: what it concerns. found: what is the matter. remedy: what to do.
    """

    level: Literal["problem", "weak"]
    kind: str
    ids: tuple[str, ...]
    found: str
    remedy: str


@dataclass(frozen=True, eq=False)
class Beforehand:
    """All findings, problems first. expected: precision at the start values, None where there is none."""

    findings: tuple[Finding, ...]
    expected: Adjustment | None


def look_beforehand(survey: Survey) -> Beforehand:
    """Everything that is looked at, in the order in which it is to be mended."""
    case, used = Case(survey), _usage(survey)
    expected, undetermined = _expected(survey)
    every = [*undetermined, *_lonely_ids(survey, used), *_points(survey, used, expected), *_epochs(survey),
             *_images(case), *_cameras(case), *_sigmas(survey)]  # fmt: skip
    if expected is not None:
        every += _weak(expected)
    return Beforehand(tuple(sorted(every, key=lambda f: f.level != "problem")), expected)


def _expected(survey: Survey) -> tuple[Adjustment | None, list[Finding]]:
    """The precision to be expected, or why there is none."""
    try:
        survey = supported(survey)[0]
    except IndeterminateError as error:
        return None, [_undetermined(error)]
    try:
        found = find_start(survey)
    except SurveyError as error:
        return None, [Finding("problem", "no start values", (), str(error), "mend that first")]
    try:
        return expect(survey, start_values(found)), []
    except IndeterminateError as error:
        return None, [_undetermined(error)]
    except SurveyError as error:
        return None, [Finding("problem", "no start values", (), str(error), "mend that first")]


def _undetermined(error: IndeterminateError) -> Finding:
    return Finding("problem", "undetermined", (), str(error), "measure or fix what is named")


def _usage(survey: Survey) -> Counter[str]:
    """How many observed components world points have, by id: two for an image point, three for coordinates."""
    out: Counter[str] = Counter()

    def add(refs: Iterable[PositionRef | None], n: int = 1) -> None:
        out.update({str(r.point_id): n for r in refs if r is not None and r.frame is None})

    for block in survey.image_blocks:
        if block.target_id is None:
            rows = block.point_idx[block.mask]
            for i in rows.tolist():
                out[survey.points[i].point_id] += 2
    for r in (r for r in survey.readings if r.used):
        for ref in {r.at, r.to, r.second}:
            add([ref])
    for d in (d for d in survey.distances if d.used):
        add([d.a])
        add([d.b])
    for c in (c for c in survey.coordinates if c.used):
        for ref in c.positions:
            add([ref], 3)
    for b in (b for b in survey.coordinate_differences if b.used):
        for ref in (*b.at, *b.to):
            add([ref], 3)
    for o in (o for o in survey.on_surfaces if o.used):
        add([o.position])
    return out


def _lonely_ids(survey: Survey, used: Mapping[str, int]) -> Iterator[Finding]:
    """Free points that a single sight names: often a name typed wrongly."""
    sights: Counter[str] = Counter()
    for r in survey.readings:
        sights.update({str(x.point_id) for x in (r.at, r.to, r.second) if x is not None and x.frame is None})
    for b in survey.image_blocks:
        if b.target_id is None:
            sights.update(survey.points[i].point_id for i in b.point_idx.tolist())
    for p in survey.points:
        if p.x_in_world.treatment == "free" and sights[p.point_id] == 1 and used.get(p.point_id, 0) <= 2:
            yield Finding("problem", "id appears once", (p.point_id,), f"point {p.point_id} is observed a single time",
                          "look for a name typed wrongly, or observe it from another place")  # fmt: skip


def _points(survey: Survey, used: Mapping[str, int], expected: Adjustment | None) -> Iterator[Finding]:
    """Points with no more components than unknowns: a gross error there cannot be found."""
    bare = [p.point_id for p in survey.points if p.x_in_world.treatment == "free"
            and 0 < used.get(p.point_id, 0) <= 3 - len(p.x_in_world.held)]  # fmt: skip
    if bare and expected is not None:
        yield Finding("weak", "no redundancy", tuple(bare), f"points without redundancy: {listed(bare, 6)}",
                      "observe each once more, best from another direction: an error there shows nowhere")  # fmt: skip


def _epochs(survey: Survey) -> Iterator[Finding]:
    """Epochs that join nothing: one camera alone sees something that is there at this epoch alone."""
    movers = {s.station_id for s in survey.stations if s.motion == "epoch"}
    hand_held = {t.target_id for t in survey.targets if t.motion == "epoch"}
    seen: dict[str, set[str]] = {}
    alone: dict[str, bool] = {}
    station_of = {c.camera_id: c.station_id for c in survey.cameras}
    for b in survey.image_blocks:
        seen.setdefault(b.epoch_id, set()).add(b.camera_id)
        loose = b.target_id in hand_held or (station_of[b.camera_id] in movers)
        alone[b.epoch_id] = alone.get(b.epoch_id, True) and loose
    tied = {r.epoch_id for p in survey.pairs for r in (p.a, p.b)}
    lonely = [e for e, cameras in seen.items() if len(cameras) == 1 and alone[e] and e not in tied]
    rig = len({station_of[c] for cs in seen.values() for c in cs}) < len({c for cs in seen.values() for c in cs})
    if rig and lonely and len(lonely) > 0.5 * len(seen):
        yield Finding("weak", "epochs without partners", tuple(lonely),
                      f"{len(lonely)} of {len(seen)} epochs are seen by one camera alone: {listed(lonely, 6)}",
                      "they join no cameras; check the names of files, or take epochs that two see")  # fmt: skip
    read = {t.epoch_id: t.table_id for t in survey.table_readings}
    blind = [e for e in read if e not in seen]
    if blind and survey.image_blocks:
        yield Finding("weak", "epochs without partners", tuple(blind),
                      f"{len(blind)} table readings have no image of their epoch: {listed(blind, 6)}",
                      "check the names of epochs in table_angles.csv and of the image files")  # fmt: skip


def _images(case: Case) -> Iterator[Finding]:
    """Single images: covered too little, the board too far or seen too flat."""
    cameras = {c.camera_id: c for c in case.survey.cameras}
    small, far, flat = list[str](), list[str](), list[str]()
    for i, b in enumerate(case.survey.image_blocks):
        if b.target_id is None or len(b.uv) < 4:
            continue
        name, size = f"{b.camera_id}/{b.epoch_id}", np.array(cameras[b.camera_id].image_size)
        if float(np.prod(np.ptp(b.uv, axis=0) / size)) < _SMALL_IMAGE**2:
            small.append(name)
        if _spacing(b.uv) < _NEAR_POINTS_PX:
            far.append(name)
        view = case.views.get(i)
        if view is not None and len(view.poses) and _incidence(view.poses[0]) > _FLATTEST:
            flat.append(name)
    for kind, names, found, remedy in (
        ("target small in the image", small, "the target covers less than a seventh of the image's sides",
         "go nearer, or take a larger target"),
        ("target too far", far, f"neighbouring points are less than {_NEAR_POINTS_PX:.0f} px apart",
         "go nearer, or take larger squares: corners this near disturb each other"),
        ("target too flat", flat, f"the target is seen at more than {np.degrees(_FLATTEST):.0f} deg from its normal",
         "turn it towards the camera: 20 to 50 deg is best"),
    ):  # fmt: skip
        if names:
            yield Finding("weak", kind, tuple(names), f"{len(names)} images: {found}: {listed(names, 6)}", remedy)


def _spacing(uv: FloatArray) -> float:
    """Median distance (px) of a point from its nearest neighbour, of 60 points at most."""
    some = uv[:: max(1, len(uv) // 60)]
    apart = np.linalg.norm(some[:, None] - uv[None], axis=2)
    apart[apart == 0.0] = np.inf
    return float(np.median(apart.min(axis=1)))


def _incidence(camera_from_target: FloatArray) -> float:
    """Angle (rad) between the target's normal and the line of sight to its origin."""
    sight = camera_from_target[:3, 3] / np.linalg.norm(camera_from_target[:3, 3])
    return float(np.arccos(min(1.0, abs(float(camera_from_target[:3, 2] @ sight)))))


def _cameras(case: Case) -> Iterator[Finding]:
    """Free lenses from too few, frontal or similar views, or from a part of the image."""
    for camera in case.survey.cameras:
        if not camera.lens.free:
            continue
        blocks = [(i, b) for i, b in enumerate(case.survey.image_blocks) if b.camera_id == camera.camera_id]
        if not blocks:
            yield Finding("problem", "camera without images", (camera.camera_id,),
                          f"camera {camera.camera_id} has no image points", "detect them, or remove it")  # fmt: skip
            continue
        yield from _coverage(camera, np.concatenate([b.uv for _, b in blocks]))
        poses = [case.views[i].poses[0] for i, _ in blocks if i in case.views and len(case.views[i].poses)]
        if camera.lens.prior is None and poses:
            yield from _views(camera, np.array(poses))


def _coverage(camera: Camera, uv: FloatArray) -> Iterator[Finding]:
    size = np.array(camera.image_size, dtype=float)
    cells = np.clip((uv / size * _CELLS).astype(int), 0, np.array(_CELLS) - 1)
    share = len(np.unique(cells, axis=0)) / (_CELLS[0] * _CELLS[1])
    if share < _COVERED:
        missing = [n for n, part in (("left", cells[:, 0] < 2), ("right", cells[:, 0] >= _CELLS[0] - 2),
                                     ("top", cells[:, 1] < 2), ("bottom", cells[:, 1] >= _CELLS[1] - 2))
                   if not part.any()]  # fmt: skip
        where = f", none at the {' and '.join(missing)}" if missing else ""
        yield Finding("weak", "image not covered", (camera.camera_id,),
                      f"camera {camera.camera_id}: its points cover {100 * share:.0f} % of the image{where}",
                      "bring the target into corners and edges: distortion is unknown where no points are")  # fmt: skip


def _views(camera: Camera, poses: FloatArray) -> Iterator[Finding]:
    tilts = np.arccos(np.clip(np.abs(poses[:, 2, 2]), 0.0, 1.0))
    if len(poses) < _FEW_VIEWS:
        yield Finding("weak", "few views", (camera.camera_id,), f"camera {camera.camera_id}: {len(poses)} views for "
                      f"{len(camera.lens.free)} free lens parameters", "take ten, tilted by 20 to 50 deg")  # fmt: skip
    elif np.quantile(tilts, 0.8) < _STEEPEST:
        yield Finding("problem", "only frontal views", (camera.camera_id,),
                      f"camera {camera.camera_id}: {np.degrees(np.quantile(tilts, 0.8)):.0f} deg tilt at most in four "
                      "of five views: focal length and distance replace each other",
                      "take five views tilted by 20 to 50 deg, about both axes")  # fmt: skip


def _sigmas(survey: Survey) -> Iterator[Finding]:
    """Sigmas and values that look like another unit."""
    by_kind: dict[str, list[tuple[str, float]]] = {}
    for r in survey.readings:
        by_kind.setdefault(r.kind, []).append((r.reading_id, r.sigma))
    for d in survey.distances:
        by_kind.setdefault("distance", []).append((d.distance_id, d.sigma))
    for kind, found in by_kind.items():
        usual = float(np.median([s for _, s in found]))
        odd = [n for n, s in found if not usual / _ODD_SIGMA < s < usual * _ODD_SIGMA]
        if odd:
            yield Finding("problem", "suspicious sigma", tuple(odd), f"{kind} {listed(odd, 6)}: the sigma is more than "
                          f"{_ODD_SIGMA:.0f} times off that of the others", "check its unit")  # fmt: skip
    yield from _lengths(survey)


def _lengths(survey: Survey) -> Iterator[Finding]:
    """Distances that stand to the others of their set-up as a unit to another."""
    by_setup: dict[str, list[tuple[str, float]]] = {}
    for r in survey.readings:
        if r.kind in ("slope_distance", "horizontal_distance"):
            by_setup.setdefault(r.setup_id, []).append((r.reading_id, r.value))
    typical = {s: float(np.median([v for _, v in found])) for s, found in by_setup.items() if len(found) >= 3}
    if len(typical) < 2:
        return
    usual = float(np.median(list(typical.values())))
    for setup_id, length in typical.items():
        ratio = length / usual
        if not 0.02 < ratio < 50.0:
            near = min(LENGTH_RATIOS, key=lambda said: abs(float(np.log(LENGTH_RATIOS[said] * ratio))))
            yield Finding("problem", "suspicious unit", (setup_id,), f"distances of set-up {setup_id} are {ratio:.3g} "
                          f"times those of the others: perhaps they {near}", "check value_m and value_mm")  # fmt: skip


def _weak(expected: Adjustment) -> Iterator[Finding]:
    if expected.redundancy <= 0:
        yield Finding("problem", "no redundancy", (), f"{expected.n_observations} observations for "
                      f"{expected.n_unknowns} unknowns: nothing checks them", "measure more")  # fmt: skip
    for direction in weak_directions(expected, 3, _WEAK):
        parts = [f"{a} {c}" for a, c, _ in direction.parts[:4]]
        yield Finding("weak", "weak geometry", tuple(parts), f"{', '.join(parts)} replace each other "
                      f"({direction.factor:.0f} times worse together than each alone)",
                      "hold one of them, give it a prior, or measure from other directions")  # fmt: skip
