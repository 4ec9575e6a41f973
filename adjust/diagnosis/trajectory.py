"""Why the epochs of a navigation do not fit its calibration: images, names, readings of the table; each tried on a few.

What concerns the calibration itself is diagnosed where it is adjusted.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from adjust.diagnosis.case import CAP
from adjust.diagnosis.hypothesis import ChangeColumns, Edit, Rename
from adjust.diagnosis.images.maps import MIRRORED, TURNED, ImageMap
from adjust.diagnosis.units.conventions import ANGLE_RATIOS
from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray
from adjust.navigation import Beacons, EpochPose, Head, NavigateOptions, NavigationEpoch, Spots, Trajectory, navigate
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2

_TRIED, _MOST_BEACONS, _SHOWN = 4, 4, 3
_ALPHA, _EXPLAINED, _BAD = 1e-4, 0.5, 3.0
"""Level shared by all that is tried; share of the misfit that a cause takes away; misfit over its count looked into."""

Change = Callable[[NavigationEpoch], NavigationEpoch]


@dataclass(frozen=True, eq=False)
class OfTrajectory:
    """One cause. ids: of cameras, beacons or the table. edits: the same in a project, as far as a program can do it.

    explained: share of the misfit beyond noise that goes with the change; statistic: its drop; critical: its limit.
    """

    name: str
    cause: str
    change: str
    kind: str
    ids: tuple[str, ...]
    edits: tuple[Edit, ...]
    explained: float
    statistic: float
    critical: float


def causes_of_trajectory(
    head: Head, beacons: Beacons, epochs: Sequence[NavigationEpoch], found: Trajectory, options: NavigateOptions,
    image_sizes: Mapping[str, tuple[int, int]],
) -> tuple[OfTrajectory, ...]:  # fmt: skip
    """What explains that spots have no beacon, miss it, or leave poses open, the best first; empty where all fits.

    found: the trajectory with these options. image_sizes: (width, height) px by camera.
    """
    places = {e.epoch_id: i for i, e in enumerate(epochs)}
    order = np.argsort([-_misfit(pose) for pose in found.epochs], kind="stable")[:_TRIED]
    some = [epochs[places[found.epochs[i].epoch_id]] for i in sorted(order.tolist())]
    alone = replace(options, motion=None)
    try:
        first = navigate(head, beacons, some, alone)
        base = _sum(first)
        n = float(sum(2 * len(s.uv) for e in some for s in e.spots))
        if base < _BAD * n:
            return ()
        trials = list(_trials(head, beacons, some, first, alone, image_sizes))
        after = [_sum(navigate(head, beacons, [t.make(e) for e in some], alone)) for t in trials]
    except SurveyError:
        return ()
    scale = max(1.0, min([*after, base]) / n)
    critical = float(chi2.isf(sidak(_ALPHA, len(trials)), 1))
    out = []
    for trial, left in zip(trials, after, strict=True):
        share = (base - left) / max(base - n, 1.0)
        if (base - left) / scale > critical and share > _EXPLAINED:
            out.append(OfTrajectory(trial.name, trial.cause, trial.change, trial.kind, trial.ids, trial.edits(epochs),
                                    min(1.0, share), (base - left) / scale, critical))  # fmt: skip
    return tuple(sorted(out, key=lambda c: -c.statistic)[:_SHOWN])


@dataclass(frozen=True, eq=False)
class _Trial:
    name: str
    cause: str
    change: str
    kind: str
    ids: tuple[str, ...]
    make: Change
    edits: Callable[[Sequence[NavigationEpoch]], tuple[Edit, ...]] = lambda _: ()


def _sum(found: Trajectory) -> float:
    return sum(_misfit(e) for e in found.epochs)


def _misfit(pose: EpochPose) -> float:
    """Chi-square, with the bound for every spot that has no beacon."""
    spots = [label for labels in pose.labels for label in labels]
    without = sum(label is None for label in spots)
    chi = pose.chi_square if np.isfinite(pose.chi_square) else 0.0
    known = min(chi, 2.0 * CAP * (len(spots) - without))
    return known + 2.0 * CAP * (len(spots) if pose.status == "none" else without)


def _trials(
    head: Head, beacons: Beacons, some: Sequence[NavigationEpoch], found: Trajectory, alone: NavigateOptions,
    image_sizes: Mapping[str, tuple[int, int]],
) -> Iterator[_Trial]:  # fmt: skip
    cameras = list(dict.fromkeys(s.camera_id for e in some for s in e.spots))
    for camera in cameras:
        for one in MIRRORED:
            yield _mapped(camera, "images mirrored", "mirrored", one, image_sizes[camera])
        for one in TURNED.values():
            yield _mapped(camera, "images turned", "turned", one, image_sizes[camera])
    for a, b in combinations(cameras, 2):
        yield _Trial(
            "cameras exchanged", f"cameras {a} and {b} have each other's images at the epochs navigated",
            f"exchange them between images/{a} and images/{b}", "camera", (a, b), _renamed_cameras({a: b, b: a}),
            _rename_edits("camera_id", {a: b, b: a}),
        )  # fmt: skip
    yield from _beacons(head, beacons, some, found, alone)
    yield from _tables(some)


def _mapped(camera: str, name: str, what: str, how: ImageMap, size: tuple[int, int]) -> _Trial:
    A, b = how.matrix, how.offset(size)

    def make(epoch: NavigationEpoch) -> NavigationEpoch:
        return replace(epoch, spots=tuple(
            replace(s, uv=s.uv @ A.T + b, cov=A @ s.cov @ A.T) if s.camera_id == camera else s
            for s in epoch.spots))  # fmt: skip

    def edits(epochs: Sequence[NavigationEpoch]) -> tuple[Edit, ...]:
        where = {"camera_id": (camera,), "epoch_id": tuple(e.epoch_id for e in epochs)}
        named = any(s.beacon_ids is not None for e in epochs for s in e.spots)
        return (ChangeColumns("image_points" if named else "spots", ("u_px", "v_px"), A, b, where),)

    return _Trial(name, f"camera {camera}: its images of the epochs navigated are {what}: {how.text}",
                  f"bring them back as they were when camera {camera} was calibrated, and detect them again",
                  "camera", (camera,), make, edits)  # fmt: skip


def _renamed_cameras(other: Mapping[str, str]) -> Change:
    def make(epoch: NavigationEpoch) -> NavigationEpoch:
        spots = tuple(replace(s, camera_id=other.get(s.camera_id, s.camera_id)) for s in epoch.spots)
        return replace(epoch, spots=spots)

    return make


def _rename_edits(column: str, other: Mapping[str, str]) -> Callable[[Sequence[NavigationEpoch]], tuple[Edit, ...]]:
    def edits(epochs: Sequence[NavigationEpoch]) -> tuple[Edit, ...]:
        named = any(s.beacon_ids is not None for e in epochs for s in e.spots)
        where = {"epoch_id": tuple(e.epoch_id for e in epochs)}
        return (Rename("image_points" if named else "spots", column, other, where),)

    return edits


def _beacons(
    head: Head, beacons: Beacons, some: Sequence[NavigationEpoch], found: Trajectory, alone: NavigateOptions
) -> Iterator[_Trial]:  # fmt: skip
    """Names of spots exchanged: those that were refused, for what the others say that they are."""
    poses = {e.epoch_id: e for e in found.epochs}
    asked = [_forgotten(epoch, poses[epoch.epoch_id]) for epoch in some]
    meant: Counter[tuple[str, str]] = Counter()
    for epoch, pose in zip(some, navigate(head, beacons, asked, alone).epochs, strict=True):
        for s, labels in zip(epoch.spots, pose.labels, strict=True):
            for name, label in zip(s.beacon_ids or (), labels, strict=False):
                if name is not None and label is not None and name != label:
                    a, b = sorted((name, label))
                    meant[a, b] += 1
    for (a, b), _ in meant.most_common(_MOST_BEACONS):
        other = {a: b, b: a}

        def spot(s: Spots, other: Mapping[str, str] = other) -> Spots:
            ids = s.beacon_ids
            return s if ids is None else replace(s, beacon_ids=tuple(other.get(str(i), i) for i in ids))

        def make(epoch: NavigationEpoch, spot: Callable[[Spots], Spots] = spot) -> NavigationEpoch:
            return replace(epoch, spots=tuple(spot(s) for s in epoch.spots))

        yield _Trial("points exchanged", f"points {a} and {b} are called by each other's names at the epochs navigated",
                     "exchange them in point_id of image_points.csv", "point", (a, b), make,
                     _rename_edits("point_id", other))  # fmt: skip


def _forgotten(epoch: NavigationEpoch, pose: EpochPose) -> NavigationEpoch:
    """Without the names of spots that were refused."""

    def spots(s: Spots, labels: Sequence[str | None]) -> Spots:
        known = s.beacon_ids and tuple(n if label == n else None for n, label in zip(s.beacon_ids, labels, strict=True))
        return replace(s, beacon_ids=known or None)

    return replace(epoch, spots=tuple(spots(s, x) for s, x in zip(epoch.spots, pose.labels, strict=True)))


def _tables(some: Sequence[NavigationEpoch]) -> Iterator[_Trial]:
    """Readings of the table with another sign, order or unit."""
    k = next((len(e.table_angles) for e in some if e.table_angles is not None), 0)
    ways = [(np.diag([-1.0 if i == axis else 1.0 for i in range(k)]), f"axis {axis + 1} counts the other way round")
            for axis in range(k)]  # fmt: skip
    ways += [(np.eye(2)[::-1], "the readings of its two axes are exchanged")] if k == 2 else []
    ways += [(factor * np.eye(k), f"its readings {said}") for said, factor in ANGLE_RATIOS.items()
             if said.endswith("read as degrees")] if k else []  # fmt: skip
    for A, said in ways:

        def make(epoch: NavigationEpoch, A: FloatArray = A) -> NavigationEpoch:
            angles = epoch.table_angles
            return epoch if angles is None else replace(epoch, table_angles=A @ angles)

        yield _Trial("table readings", f"table: at the epochs navigated {said}", "correct them in table_angles.csv, or "
                     "navigate with --no-table", "table", (), make, _angle_edits(A))  # fmt: skip


def _angle_edits(by: FloatArray) -> Callable[[Sequence[NavigationEpoch]], tuple[Edit, ...]]:
    columns = tuple(f"axis{i + 1}_deg" for i in range(len(by)))

    def edits(epochs: Sequence[NavigationEpoch]) -> tuple[Edit, ...]:
        where = {"epoch_id": tuple(e.epoch_id for e in epochs)}
        return (ChangeColumns("table_angles", columns, by, np.zeros(len(by)), where),)

    return edits
