"""Cameras that do not expose at the same time: each fits alone, together they do not, in proportion to the motion.

The time offset of a camera is one unknown: what its images are off by, over how fast the target moves there (both from
the poses of single images), by least squares; the unit is the interval between epochs.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from gtsam import Pose3

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place
from adjust.diagnosis.sequences import Link, links
from adjust.diagnosis.time.clocks import Freed, as_unknowns
from adjust.model.frozen import frozen
from adjust.model.rewriting import with_rows
from adjust.model.survey import PoseParameter, Station, Survey
from adjust.testing.criteria import sidak
from adjust.testing.distributions import norm

_ALPHA = 1e-4
_ALONE_PX = 1.0
_SPREAD = 5.0


@frozen
class Offset:
    """Of a camera after another, in intervals between epochs. misses: m, typical, of the board between the two."""

    camera_id: str
    reference_id: str
    intervals: float
    sigma: float
    misses: float


def unsynchronised(case: Case) -> Iterator[Hypothesis]:
    """All cameras that see a moving target expose at their own times: as clocks, else with nothing in common."""
    rigs = [link for link in links(case) if link.kind == "rig"]
    offsets = [o for o in (time_offset(link) for link in rigs) if o is not None]
    bound = norm.isf(sidak(_ALPHA, len(rigs)))
    clear = [o for o in offsets if abs(o.intervals) > bound * o.sigma]
    seen = float(np.median([v.error_px[0] for v in case.views.values()] or [np.inf]))
    if not clear or not seen < _ALONE_PX:
        return
    worst = max(clear, key=lambda o: abs(o.intervals) / o.sigma)
    cameras = tuple(sorted({o.camera_id for o in offsets} | {o.reference_id for o in offsets}))
    said = ", ".join(
        f"{o.camera_id} after {o.reference_id} by {o.intervals:+.2f} +- {o.sigma:.2f} intervals" for o in clear[:4]
    )
    hypothesis = Hypothesis(
        "cameras not simultaneous",
        f"cameras {', '.join(cameras)} do not expose at the same time: each fits alone ({seen:.2f} px), but camera "
        f"{worst.camera_id} sees the moving target typically {1e3 * worst.misses:.1f} mm from where camera "
        f"{worst.reference_id} does, in proportion to its motion ({said})",
        "trigger the cameras together, or hold the target still at every epoch, and measure again",
        Place("camera", (worst.camera_id,)), case.survey, (), abs(worst.intervals) / worst.sigma, 1,
        max(1, len(rigs)),
    )  # fmt: skip
    clocked = {c.camera_id for c in case.survey.cameras if c.clock is not None}
    late: Freed = {("camera_clock", c): ("offset",) for c in cameras[1:] if c not in clocked}
    explained: list[bool] = []
    if late:
        yield as_unknowns(case, hypothesis, late, noted=explained)
    alone, n_epochs = apart(case.survey, cameras[1:])
    if alone is not None:
        own = _with_own_lenses(alone, case, cameras)
        yield replace(hypothesis, survey=lambda: None if any(explained) else own, parameters=6 * n_epochs)


def time_offset(link: Link) -> Offset | None:
    """The second's offset after the first, by least squares; None where the target hardly moves."""
    fit = link.fit
    if fit is None or len(link.epochs) < 6:
        return None
    seen, moved = link.first[:, :3, 3], (fit.left @ link.second)[:, :3, 3]
    velocity = 0.5 * (seen[2:] - seen[:-2])
    miss = (seen - moved)[1:-1]
    steps = np.linalg.norm(np.diff(seen, axis=0), axis=1)
    whole = (steps[1:] < _SPREAD * np.median(steps)) & (steps[:-1] < _SPREAD * np.median(steps))
    velocity, miss = velocity[whole], miss[whole]
    if len(miss) < 4 or np.linalg.norm(velocity) < 1e-9:
        return None
    A = np.hstack([-velocity.reshape(-1, 1), np.tile(np.eye(3), (len(miss), 1))])  # the rest of the rig's fit beside
    N = A.T @ A
    if np.linalg.cond(N) > 1e10:
        return None
    x = np.linalg.solve(N, A.T @ miss.ravel())
    rest = miss.ravel() - A @ x
    variance = float(rest @ rest) / max(1, rest.size - 4) * np.linalg.inv(N)[0, 0]
    return Offset(link.names[1], link.names[0], float(x[0]), float(np.sqrt(variance)),
                  float(np.median(np.linalg.norm(miss, axis=1))))  # fmt: skip


def apart(survey: Survey, cameras: tuple[str, ...]) -> tuple[Survey | None, int]:
    """The survey in which each of these cameras has epochs, and a fixed body, of its own; how many epochs that adds.

    Nothing joins such a camera with the others any more: its body is held where it is, at the world's origin. None
    where cameras stand on bodies that move.
    """
    chosen = {c.camera_id: c for c in survey.cameras if c.camera_id in cameras}
    if any(survey.stations_by_id[c.station_id].motion != "fixed" for c in chosen.values()):
        return None, 0
    mine = {i: b for i, b in enumerate(survey.image_blocks) if b.camera_id in chosen}
    blocks = {i: replace(b, epoch_id=f"{b.epoch_id} of {b.camera_id}") for i, b in mine.items()}
    held = PoseParameter(Pose3(), "held")
    new = {i: replace(c, station_id=f"body of {c.camera_id}", station_from_camera=held)
           for i, c in enumerate(survey.cameras) if c.camera_id in chosen}  # fmt: skip
    bodies = tuple(Station(f"body of {c}", world_from_station=held) for c in chosen)
    added = {b.epoch_id for b in blocks.values()} - {b.epoch_id for b in survey.image_blocks}
    out = with_rows(with_rows(survey, "image_blocks", blocks), "cameras", new)
    return replace(out, stations=survey.stations + bodies), len(added)


def _with_own_lenses(survey: Survey, case: Case, cameras: tuple[str, ...]) -> Survey:
    """Each of these cameras with the lens that its own images give: alone, its focal length and poses wander."""
    known = {i: c for i, c in enumerate(survey.cameras) if c.camera_id in cameras and c.camera_id in case.lenses}
    lenses = {i: replace(c.lens, values=case.lenses[c.camera_id], free=(), prior=None) for i, c in known.items()}
    return with_rows(survey, "cameras", {i: replace(c, lens=lenses[i]) for i, c in known.items()})
