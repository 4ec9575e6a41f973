"""What observations and datum leave undetermined, by name."""

import gtsam
import numpy as np

from adjust.frames.unknowns import Unknown
from adjust.graph.assembly import AdjustmentGraph
from adjust.graph.datum import BLIND, Stacking, gauges, independent_rows, stacking, times, visible_keys
from adjust.model.errors import IndeterminateError, listed
from adjust.model.survey import FloatArray, Station
from adjust.observations.images.bundle_hidden import BundleHidden

_MOST_DIMS = 6000
BLIND_BUNDLE = 2e-7
"""As ``BLIND``, where poses and points are hidden; undetermined directions reach 3e-8, determined ones 6e-6."""
_BLIND_FOR_SURE = 1e-11
"""As ``BLIND``, of long corridors, whose ends tell little of each other."""
_READABLE = {"rx": "rotation x", "ry": "rotation y", "rz": "rotation z", "tx": "x", "ty": "y", "tz": "z"}


def unobserved_unknowns(graph: AdjustmentGraph) -> list[str]:
    """Unknowns that occur in no factor at all."""
    seen = set(graph.keys(graph.reduction))
    if graph.reduction is not None:
        seen |= set(graph.reduction.hidden)
    for bundle in graph.bundles:
        seen |= set(bundle.hidden_poses) | {bundle.point_key[i] for i in bundle.reduced}
    return [readable(u) for u in graph.unknowns.by_name.values() if u.key not in seen]


def readable(unknown: Unknown) -> str:
    """An unknown as people say it."""
    kind, *ids = unknown.name
    owner = {
        "lens": "lens of camera {}",
        "lens_drift": "change of the lens of camera {}",
        "lens_crop": "crop of the images of camera {}",
        "station_from_camera": "pose of camera {} on its station",
        "mount_from_station": "pose of station {} on the table's mount",
        "world_from_station": "pose of station {}",
        "world_from_table": "pose of table {}",
        "table_geometry": "axes of table {}",
        "table_angles": "angles of table {}",
        "carrier_from_target": "pose of target {}",
        "warp": "warp of target {}",
        "point": "point {}",
        "vertical": "direction of the vertical",
        "instrument": "instrument {}",
        "orientation": "orientation of setup {}",
        "centring": "centring of setup {}",
        "beam": "laser beam {}",
        "surface": "surface {}",
        "camera_clock": "clock of camera {}",
        "table_clock": "clock of table {}",
        "pose_clock": "clock of the poses of station {}",
    }[kind].format(*ids)
    return owner + (f" at epoch {ids[1]}" if len(ids) > 1 else "")


def null_space(
    linear: gtsam.GaussianFactorGraph, stack: Stacking, graph: AdjustmentGraph | None = None
) -> tuple[FloatArray, FloatArray]:
    """Null vectors (n, k) of the normal matrix of the visible unknowns, and its column scale (n,).

    Candidates come from the scaled normal matrix; each is then judged by the length of the whitened Jacobian times it,
    so that weak but determined directions are not taken for null ones. graph: where a bundle is part of it.
    """
    N = np.zeros((stack.n, stack.n))
    for i in range(linear.size()):
        factor = linear.at(i)
        A, index = factor.jacobian()[0], stack.index(factor.keys())
        N[np.ix_(index, index)] += A.T @ A
    scale = np.sqrt(np.diag(N))
    empty = scale == 0.0
    scale[empty] = 1.0
    N = N / scale[:, None] / scale
    w, V = np.linalg.eigh(N)
    V = V[:, w < 1e-7] / scale[:, None]
    if V.shape[1] == 0:
        return V, scale
    _, s, Vt = np.linalg.svd(rows_along(linear, stack, V, graph), full_matrices=False)
    # what is hidden in a bundle follows from its normal equations, to about the root of their rounding
    limit = BLIND if graph is None or not graph.bundles else BLIND_BUNDLE
    return V @ Vt[s < limit].T, scale


def describe_null_space(
    graph: AdjustmentGraph, linear: gtsam.GaussianFactorGraph, values: gtsam.Values
) -> IndeterminateError | None:
    """The error that names what is undetermined, or None where everything is determined (though perhaps weakly)."""
    stack = stacking(graph, visible_keys(graph, linear))
    if stack.n > _MOST_DIMS:
        return IndeterminateError(
            "the observations and the datum leave unknowns undetermined; the survey is too large "
            f"({stack.n} unknowns) to name them: try a part of it"
        )
    null, scale = null_space(linear, stack, graph)
    if null.shape[1] == 0:
        return None
    motions = gauges(graph, list(stack.at), values) * scale[:, None]
    scaled = _without_weak_motions(linear, stack, np.linalg.qr(null * scale[:, None])[0], motions, scale)
    if scaled.shape[1] == 0:
        return None
    naming = _Naming(graph, stack, scale, scaled)
    naming.whole_survey(motions)
    naming.station_frames(values)
    names = naming.rest()
    head = f"the observations and the datum leave {scaled.shape[1]} directions undetermined:"
    return IndeterminateError("\n  - ".join([head, *naming.lines]), tuple(names) or tuple(naming.lines))


def is_seen(graph: AdjustmentGraph, stack: Stacking, length: float) -> bool:
    """Whether a direction is surely determined, whose whitened Jacobian has this length, of one in its scale.

    Where what is undetermined could be named nothing but what is far from it is sure.
    """
    if graph.bundles:
        return length > 10.0 * BLIND_BUNDLE
    return length > (10.0 * BLIND if stack.n <= _MOST_DIMS else _BLIND_FOR_SURE)


def rows_along(
    linear: gtsam.GaussianFactorGraph, stack: Stacking, V: FloatArray, graph: AdjustmentGraph | None
) -> FloatArray:
    """The whitened Jacobian times V; a bundle's part from its image points, not through its normal equations."""
    bundles = graph.bundles if graph is not None else ()
    if not bundles:
        return times(linear, stack, V)
    out = [BundleHidden(bundle).rows_along(V[stack.index(bundle.interface)]) for bundle in bundles]
    condensed = {tuple(bundle.interface) for bundle in bundles}
    for i in range(linear.size()):
        factor = linear.at(i)
        if tuple(factor.keys()) not in condensed:
            out.append(factor.jacobian()[0] @ V[stack.index(factor.keys())])
    return np.concatenate(out)


def _without_weak_motions(
    linear: gtsam.GaussianFactorGraph, stack: Stacking, null: FloatArray, motions: FloatArray, scale: FloatArray
) -> FloatArray:
    """The null space (n, k) less motions of the whole survey that a weak datum does see: a bundle is blind to them."""
    _, common = _intersection(null, motions)
    if common.shape[1] == 0:
        return null
    _, s, Vt = np.linalg.svd(times(linear, stack, common / scale[:, None]), full_matrices=False)
    return _complement(null, common @ Vt[s >= BLIND].T)


def _complement(null: FloatArray, found: FloatArray) -> FloatArray:
    """Orthonormal basis of what is left of span(null) beside span(found), which lies in it."""
    if found.shape[1] == 0:
        return null
    U, s, _ = np.linalg.svd(null.T @ found, full_matrices=True)
    rank = int(np.sum(s > 1e-6 * s.max()))
    return np.asarray(null @ U[:, rank:])


def _intersection(null: FloatArray, B: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What span(null) (orthonormal) and span(B) have in common: coefficients (b, k) of B's columns, basis (n, k)."""
    lengths = np.linalg.norm(B, axis=0)
    usable = np.flatnonzero(lengths > 1e-12)
    U, s, Vt = np.linalg.svd(B[:, usable] / lengths[usable], full_matrices=False)
    keep = s > 1e-9
    basis, back = U[:, keep], Vt[keep].T / s[keep]
    L, cosines, _ = np.linalg.svd(basis.T @ null)
    inside = np.flatnonzero(cosines > 1.0 - 1e-7)
    coefficients = np.zeros((B.shape[1], len(inside)))
    coefficients[usable] = (back @ L[:, inside]) / lengths[usable, None]
    return coefficients, basis @ L[:, inside]


def _gauge_text(involved: list[int]) -> str:
    parts = []
    for what, first in (("position along world", 0), ("rotation about world", 3)):
        axes = ["xyz"[i - first] for i in involved if first <= i < first + 3]
        if axes:
            parts.append(f"{what} {', '.join(axes)}")
    return " and the ".join(parts + (["scale"] if 6 in involved else []))


def _frame_motion(graph: AdjustmentGraph, keys: list[int], station_id: str, values: gtsam.Values) -> FloatArray | None:
    """How the unknowns move (n, 6) when a station's own frame is moved; None where something holds that frame."""
    survey, u = graph.survey, graph.unknowns
    inside = [("station_from_camera", c.camera_id) for c in survey.cameras if c.station_id == station_id]
    inside += [("carrier_from_target", t.target_id) for t in survey.targets if t.station_id == station_id]
    motion: dict[int, FloatArray] = {}
    for name, slot in u.slot_of.items():
        mine = name in inside or (name[0] == "carrier_from_target" and name[:2] in inside)
        outside = name[0] in ("world_from_station", "mount_from_station") and name[1] == station_id
        if not mine and not outside:
            continue
        key = u.slot_key[slot]
        if key is None:
            return None
        motion[key] = values.atPose3(key).inverse().AdjointMap() if mine else -np.eye(6)
    if not motion:
        return None
    return np.concatenate([motion.get(k, np.zeros((u.by_key[k].dim, 6))) for k in keys])


class _Naming:
    """Lines on what moves in a null space (n, k), scaled and orthonormal; found: bases of what has been named."""

    def __init__(self, graph: AdjustmentGraph, stack: Stacking, scale: FloatArray, null: FloatArray) -> None:
        self.graph, self.stack, self.scale, self.null = graph, stack, scale, null
        self.lines: list[str] = []
        self.found = [np.zeros((len(null), 0))]

    def whole_survey(self, motions: FloatArray) -> None:
        """Of its motions (n, 7), scaled."""
        coefficients, common = _intersection(self.null, motions)
        if coefficients.shape[1]:
            share = np.abs(coefficients) * np.linalg.norm(motions, axis=0)[:, None]
            involved = [i for i in range(7) if share[i].max() > 1e-3 * share.max()]
            count = "" if len(involved) == coefficients.shape[1] else f"{coefficients.shape[1]} directions of "
            self.lines.append(
                f"the datum: {count}the {_gauge_text(involved)} of the whole survey: hold a target, a station or "
                "coordinates, observe coordinates or a distance, or set the datum to inner constraints"
            )
        self.found.append(common)

    def station_frames(self, values: gtsam.Values) -> None:
        """Of stations whose own frame is free, where that is new."""
        for station in self.graph.survey.stations:
            motion = _frame_motion(self.graph, list(self.stack.at), station.station_id, values)
            if motion is None:
                continue
            coefficients, common = _intersection(self.null, motion * self.scale[:, None])
            if coefficients.shape[1] and _rank(np.hstack([*self.found, common])) > _rank(np.hstack(self.found)):
                self.found.append(common)
                length = np.linalg.norm(motion * self.scale[:, None], axis=0)
                self.lines.append(_frame_text(station, coefficients * length[:, None]))

    def rest(self) -> list[str]:
        """Of what moves together in what is left, each direction by one component that no other one moves."""
        null = _complement(self.null, np.hstack(self.found)) / self.scale[:, None]
        if null.shape[1] == 0:
            return []
        size = np.abs(null).max(axis=1)
        pivots = independent_rows(null / np.where(size > 0, size, 1.0)[:, None] ** 0.5)
        names: list[str] = []
        for vector in (null @ np.linalg.inv(null[pivots])).T:
            texts = _moving(self.graph, self.stack, vector)
            names += texts
            self.lines.append(
                f"{listed(texts, 6, '; ')}: they move together without changing any observation; measure or hold one"
                if len(texts) > 1
                else f"{texts[0]}: the observations do not determine it; measure or hold it"
            )
        return list(dict.fromkeys(names))


def _frame_text(station: Station, coefficients: FloatArray) -> str:
    """Which directions of a station's own frame float, and what would tell them; coefficients (6, k), tangent."""
    k = coefficients.shape[1]
    share = np.abs(coefficients).max(axis=1)
    involved = [i for i in range(6) if share[i] > 1e-3 * share.max()]
    count = "" if len(involved) == k else f"{k} directions of "
    turns, shifts = ([f"{'xyz'[i % 3]}" for i in involved if (i < 3) == first] for first in (True, False))
    parts, remedies = [], []
    if shifts:
        parts.append(f"where its origin lies along its own {', '.join(shifts)}")
        remedies.append("a caliper or tape distance from its origin to a known point or camera (in distances.csv)")
    if turns:
        parts.append(f"how it is turned about its own {', '.join(turns)}")
        remedies.append("an alignment of its axes (a prior on the rotation)")
    carried = "its mount on the table" if station.motion == "table" else "its pose"
    return (
        f"the frame of station {station.station_id}: {count}{' and '.join(parts)}: nothing tells it, because the poses "
        f"of its cameras and {carried} move along; measure {' and '.join(remedies)}, or hold one camera on it or "
        f"{carried}"
    )


def _rank(basis: FloatArray) -> int:
    return int(np.linalg.matrix_rank(basis, tol=1e-6)) if basis.shape[1] else 0


def _moving(graph: AdjustmentGraph, stack: Stacking, vector: FloatArray) -> list[str]:
    """What moves along ``vector``, largest share first, what there is once before what there is at every epoch."""
    weight = np.abs(vector) / np.abs(vector).max()
    shares: dict[tuple[str, ...], tuple[float, Unknown, dict[str, None], int]] = {}
    for key, place in stack.at.items():
        unknown, part = graph.unknowns.by_key[key], weight[place]
        strong = [_READABLE.get(c, c) for c, s in zip(unknown.components, part, strict=True) if s > 0.1]
        if strong:
            at_epochs = len(unknown.name) > 2
            same = unknown.name[:2] if at_epochs else unknown.name
            most, first, components, count = shares.get(same, (0.0, unknown, {}, 0))
            components |= dict.fromkeys(strong)
            shares[same] = max(most, float(part.max())), first, components, count + 1
    ordered = sorted(shares.values(), key=lambda item: (len(item[1].name) > 2, -item[0]))
    out = []
    for _, unknown, components, count in ordered:
        owner = readable(unknown) if count == 1 else f"{readable(unknown).split(' at epoch ')[0]} at {count} epochs"
        out.append(f"{owner} ({', '.join(components)})")
    return out
