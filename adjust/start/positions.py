"""Where the points of a survey are: given, found by now, in frames that are known; and what is missing, by name."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from adjust.frames.unknowns import Chain
from adjust.model.boards import deformed
from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef, PositionRef
from adjust.model.survey import BoolArray, FloatArray, IntArray, Survey
from adjust.start.network import FrameNetwork


@frozen(eq=False)
class Sight:
    """A block of world points: positions (n,) in the survey's points, rays (n, 3) in the camera, camera_from_world."""

    block_idx: int
    text: str
    rows: IntArray
    rays: FloatArray
    focal_px: float
    chain: Chain


@dataclass(eq=False)
class PointField:
    """The world's points, (n, 3) m: nan until known. ``given`` (n,): coordinates that came with the survey.

    rough (n,): given ones that nothing but a start value tells. They stay unknown, and may be intersected, while there
    is firmer ground to go on from (targets), until they are ``released``.
    """

    x: FloatArray
    given: BoolArray
    rough: BoolArray
    sights: list[Sight] = field(default_factory=list)
    released: bool = False

    @property
    def known(self) -> BoolArray:
        """Which points (n,) have coordinates by now that may be used."""
        known = np.isfinite(self.x[:, 0])
        return np.asarray(known if self.released else known & ~self.rough)

    def release(self) -> bool:
        """Use the rough ones from now on; whether that is news."""
        news = not self.released and bool(self.rough.any())
        self.released = True
        return news

    def place(self, rows: BoolArray, x: FloatArray) -> None:
        """Set coordinates that were found; they are no given ones any more."""
        self.x[rows] = x[rows]
        self.given[rows] = self.rough[rows] = False

    def seen(self) -> BoolArray:
        """Which points (n,) any block sees."""
        out = np.zeros(len(self.x), dtype=bool)
        for sight in self.sights:
            out[sight.rows] = True
        return out


def given_points(survey: Survey) -> dict[str, FloatArray]:
    """Coordinates (3,) m that come with a survey, nan where a component is not known.

    What is held or has a prior, then what was observed, then start values.
    """
    starts, firm, observed = (dict[str, FloatArray]() for _ in range(3))
    for point in survey.points:
        parameter = point.x_in_world
        if parameter.value is not None:
            known = parameter.treatment != "free" or bool(parameter.held)
            (firm if known else starts)[point.point_id] = np.asarray(parameter.value, dtype=float)
    for item in survey.coordinates:
        variances = np.diag(item.cov).reshape(-1, 3)
        for ref, value, variance in zip(item.positions, item.values, variances, strict=True):
            if ref.frame is None and ref.point_id is not None and item.used:
                observed[ref.point_id] = np.where(np.isfinite(variance), value, np.nan)
    out = dict[str, FloatArray]()
    for values in (firm, observed, starts):
        out |= {n: np.where(np.isfinite(out[n]), out[n], x) if n in out else x for n, x in values.items()}
    return out


def point_field(survey: Survey) -> PointField:
    """The points of a survey, given or observed; where there are targets, those with a mere start value are rough."""
    x, rough = np.full((len(survey.points), 3), np.nan), np.zeros(len(survey.points), dtype=np.bool_)
    kept = tuple(p for p in survey.points if p.x_in_world.treatment != "free" or p.x_in_world.held)
    firm = {n for n, value in given_points(replace(survey, points=kept)).items() if np.isfinite(value).all()}
    given = given_points(survey)
    for i, point in enumerate(survey.points):
        value = given.get(point.point_id)
        if value is not None and np.isfinite(value).all():
            x[i], rough[i] = value, point.point_id not in firm
    boards = any(b.target_id is not None for b in survey.image_blocks)
    return PointField(x, np.isfinite(x[:, 0]), rough, released=not boards)


class Positions:
    """Where the points of a survey and of its frames are in the world, as far as it is known by now."""

    def __init__(self, survey: Survey, network: FrameNetwork, points: PointField) -> None:
        self.network, self.points = network, points
        self._row = {p.point_id: i for i, p in enumerate(survey.points)}
        self._targets = {t.target_id: (t.point_ids, deformed(t)) for t in survey.targets}
        self._chains: dict[FrameRef, Chain] = {}

    def chain(self, frame: FrameRef) -> Chain:
        """Of ``world_from_frame``."""
        if frame not in self._chains:
            self._chains[frame] = tuple(self.network.frames.world_from(frame))
        return self._chains[frame]

    def of(self, refs: Iterable[PositionRef]) -> dict[PositionRef, FloatArray]:
        """World coordinates (3,) m of those positions that are known."""
        out: dict[PositionRef, FloatArray] = {}
        poses: dict[FrameRef, FloatArray] = {}
        for ref in refs:
            if ref.frame is None:
                row = self._row.get(str(ref.point_id))
                if row is not None and np.isfinite(self.points.x[row]).all():
                    out[ref] = self.points.x[row]
                continue
            if ref.frame not in poses:
                chain = self.chain(ref.frame)
                if self.network.open_slots(chain):
                    continue
                poses[ref.frame] = self.network.product(chain)
            pose, local = poses[ref.frame], np.zeros(3)
            if ref.point_id is not None:
                ids, x = self._targets[ref.frame.frame_id]
                local = x[ids.index(ref.point_id)]
            out[ref] = np.asarray(pose[:3, :3] @ local + pose[:3, 3])
        return out

    def put(self, found: Mapping[str, FloatArray], firm: bool) -> bool:
        """Let points (3,) m without coordinates lie there, found by ``firm`` observations or given; if any does."""
        points, any_new = self.points, False
        for point_id, x in found.items():
            row = self._row.get(point_id)
            if row is not None and np.isnan(points.x[row]).any() and np.isfinite(x).all():
                points.x[row], any_new = x, True
                points.given[row], points.rough[row] = not firm, not firm and not points.released
        return any_new


def undetermined(
    survey: Survey, network: FrameNetwork, points: PointField, slots: Iterable[int], rows: Iterable[int]
) -> str:
    """One line for each of these poses and points; empty where there is none."""
    lines = [f"{' '.join(network.names[slot])}: {_missing_pose(network, points, slot)}" for slot in slots]
    lines += [f"point {survey.points[row].point_id}: {_missing_point(network, points, row)}" for row in rows]
    if not lines:
        return ""
    shown = lines[:20] + ([f"... and {len(lines) - 20} more"] if len(lines) > 20 else [])
    return "no start value can be found for " + str(len(lines)) + " parameter(s):\n  " + "\n  ".join(shown)


def _missing_pose(network: FrameNetwork, points: PointField, slot: int) -> str:
    name = network.names[slot]
    seen = [o for o in network.observations if any(link.slot == slot for link in o.chain)]
    if seen:
        others = sorted(
            {" ".join(network.names[o.chain[i].slot]) for o in seen for i in network.unknown_links(o.chain)}
        )
        together = ", ".join(o for o in others if o != " ".join(name)) or "itself only"
        return (
            f"{len(seen)} observation(s) reach it, but only together with {together}, also unknown; hold or measure one"
            " of them, or add images that connect it"
        )
    sights = [s for s in points.sights if any(link.slot == slot for link in s.chain)]
    if sights:
        most = max(int(points.known[s.rows].sum()) for s in sights)
        return (
            f"no target and at most {most} known point(s) in one image (3 needed, 4 for a single solution);"
            " give coordinates of more points, or show it a target"
        )
    epoch = f" in epoch {name[2]!r}" if len(name) == 3 else " in any epoch"
    if name[0] == "station_from_camera":
        return f"camera {name[1]!r} sees no target and no known point{epoch}; add images or give its pose"
    return f"no trusted image or pair reaches it{epoch}; add an observation or give its pose"


def _missing_point(network: FrameNetwork, points: PointField, row: int) -> str:
    seen = [s for s in points.sights if row in s.rows]
    if not seen:
        return "no image shows it and it has no coordinates; give them, or take it out of the survey"
    ready = sum(not network.unknown_links(s.chain) for s in seen)
    return (
        f"seen in {len(seen)} image(s), {ready} of them from a known pose; two from different directions are needed:"
        " add images, or give its coordinates"
    )
