"""Why the epochs of a navigation do not fit its calibration: images, names, readings of the table; each tried on a few.

What concerns the calibration itself is diagnosed where it is adjusted.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from adjust.diagnosis.case import CAP
from adjust.diagnosis.hypothesis import ChangeColumns, Edit, Rename
from adjust.diagnosis.images import MIRRORED, TURNED, ImageMap
from adjust.diagnosis.units.conventions import ANGLE_RATIOS
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from adjust.navigation import Beacons, EpochPose, Head, NavigateOptions, NavigationEpoch, Spots, Trajectory, navigate
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2

_TRIED, _MOST_BEACONS, _SHOWN = 4, 4, 3
_ALPHA, _EXPLAINED, _BAD = 1e-4, 0.5, 3.0
"""Level shared by all that is tried; share of the misfit that a cause takes away; misfit over its count looked into."""


@frozen(eq=False)
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
    explained: float = 0.0
    statistic: float = 0.0
    critical: float = 0.0


Change = Callable[[NavigationEpoch], NavigationEpoch]
_Trial = tuple[OfTrajectory, Change]


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
        asked = [_forgotten(epoch, pose) for epoch, pose in zip(some, first.epochs, strict=True)]
        rows = _Rows(epochs)
        trials = [
            *_of_images(some, image_sizes, rows), *_of_beacons(some, navigate(head, beacons, asked, alone), rows),
            *_of_tables(some, rows),
        ]  # fmt: skip
        after = [_sum(navigate(head, beacons, [make(e) for e in some], alone)) for _, make in trials]
    except SurveyError:
        return ()
    scale = max(1.0, min([*after, base]) / n)
    critical = float(chi2.isf(sidak(_ALPHA, len(trials)), 1))
    out = []
    for (cause, _), left in zip(trials, after, strict=True):
        share, drop = (base - left) / max(base - n, 1.0), (base - left) / scale
        if drop > critical and share > _EXPLAINED:
            out.append(replace(cause, explained=min(1.0, share), statistic=drop, critical=critical))
    return tuple(sorted(out, key=lambda c: -c.statistic)[:_SHOWN])


def _sum(found: Trajectory) -> float:
    return sum(_misfit(e) for e in found.epochs)


def _misfit(pose: EpochPose) -> float:
    """Chi-square, with the bound for every spot that has no beacon."""
    spots = [label for labels in pose.labels for label in labels]
    without = sum(label is None for label in spots)
    chi = pose.chi_square if np.isfinite(pose.chi_square) else 0.0
    known = min(chi, 2.0 * CAP * (len(spots) - without))
    return known + 2.0 * CAP * (len(spots) if pose.status == "none" else without)


@frozen(eq=False)
class _Rows:
    """The rows of a project that these epochs are: how each change is made there, and what it does to an epoch."""

    epochs: Sequence[NavigationEpoch]

    def cameras(self, other: Mapping[str, str]) -> tuple[tuple[Edit, ...], Change]:
        """Cameras called otherwise."""
        edit = Rename(self._spots, "camera_id", other, self._where())
        return _of_spots(edit, lambda s: replace(s, camera_id=other.get(s.camera_id, s.camera_id)))

    def beacons(self, other: Mapping[str, str]) -> tuple[tuple[Edit, ...], Change]:
        """Beacons called otherwise."""

        def renamed(s: Spots) -> Spots:
            ids = s.beacon_ids
            return s if ids is None else replace(s, beacon_ids=tuple(other.get(str(i), i) for i in ids))

        return _of_spots(Rename(self._spots, "point_id", other, self._where()), renamed)

    def mapped(self, camera: str, how: ImageMap, size: tuple[int, int]) -> tuple[tuple[Edit, ...], Change]:
        """Image points of a camera mapped back."""
        where = self._where(camera_id=(camera,))
        edit = ChangeColumns(self._spots, ("u_px", "v_px"), how.matrix, how.offset(size), where)
        return _of_spots(edit, lambda s: how.back(s, size) if s.camera_id == camera else s)

    def angles(self, by: FloatArray) -> tuple[tuple[Edit, ...], Change]:
        """Readings of the table times a matrix (k, k)."""
        columns = tuple(f"axis{i + 1}_deg" for i in range(len(by)))
        edit = ChangeColumns("table_angles", columns, by, np.zeros(len(by)), self._where())
        return (edit,), lambda e: e if e.table_angles is None else replace(e, table_angles=by @ e.table_angles)

    @property
    def _spots(self) -> str:
        named = any(s.beacon_ids is not None for e in self.epochs for s in e.spots)
        return "image_points" if named else "spots"

    def _where(self, **more: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
        return {**more, "epoch_id": tuple(e.epoch_id for e in self.epochs)}


def _of_spots(edit: Edit, of: Callable[[Spots], Spots]) -> tuple[tuple[Edit, ...], Change]:
    return (edit,), lambda epoch: replace(epoch, spots=tuple(map(of, epoch.spots)))


def _of_images(
    some: Sequence[NavigationEpoch], image_sizes: Mapping[str, tuple[int, int]], rows: _Rows
) -> Iterator[_Trial]:
    """Images of a camera mirrored or turned; those of two exchanged."""
    cameras = list(dict.fromkeys(s.camera_id for e in some for s in e.spots))
    for camera in cameras:
        for what, how in (*(("mirrored", m) for m in MIRRORED), *(("turned", t) for t in TURNED.values())):
            edits, change = rows.mapped(camera, how, image_sizes[camera])
            yield OfTrajectory(
                f"images {what}", f"camera {camera}: its images of the epochs navigated are {what}: {how.text}",
                f"bring them back as they were when camera {camera} was calibrated, and detect them again", "camera",
                (camera,), edits,
            ), change  # fmt: skip
    for a, b in combinations(cameras, 2):
        edits, change = rows.cameras({a: b, b: a})
        yield OfTrajectory(
            "cameras exchanged", f"cameras {a} and {b} have each other's images at the epochs navigated",
            f"exchange them between images/{a} and images/{b}", "camera", (a, b), edits,
        ), change  # fmt: skip


def _of_beacons(some: Sequence[NavigationEpoch], told: Trajectory, rows: _Rows) -> Iterator[_Trial]:
    """Names of spots exchanged: those that were refused, for what the others say that they are (``told``)."""
    meant: Counter[tuple[str, str]] = Counter()
    for epoch, pose in zip(some, told.epochs, strict=True):
        for s, labels in zip(epoch.spots, pose.labels, strict=True):
            for name, label in zip(s.beacon_ids or (), labels, strict=False):
                if name is not None and label is not None and name != label:
                    a, b = sorted((name, label))
                    meant[a, b] += 1
    for (a, b), _ in meant.most_common(_MOST_BEACONS):
        edits, change = rows.beacons({a: b, b: a})
        yield OfTrajectory(
            "points exchanged", f"points {a} and {b} are called by each other's names at the epochs navigated",
            "exchange them in point_id of image_points.csv", "point", (a, b), edits,
        ), change  # fmt: skip


def _forgotten(epoch: NavigationEpoch, pose: EpochPose) -> NavigationEpoch:
    """Without the names of spots that were refused."""

    def spots(s: Spots, labels: Sequence[str | None]) -> Spots:
        known = s.beacon_ids and tuple(n if label == n else None for n, label in zip(s.beacon_ids, labels, strict=True))
        return replace(s, beacon_ids=known or None)

    return replace(epoch, spots=tuple(spots(s, x) for s, x in zip(epoch.spots, pose.labels, strict=True)))


def _of_tables(some: Sequence[NavigationEpoch], rows: _Rows) -> Iterator[_Trial]:
    """Readings of the table with another sign, order or unit."""
    k = next((len(e.table_angles) for e in some if e.table_angles is not None), 0)
    ways = [(np.diag([-1.0 if i == axis else 1.0 for i in range(k)]), f"axis {axis + 1} counts the other way round")
            for axis in range(k)]  # fmt: skip
    ways += [(np.eye(2)[::-1], "the readings of its two axes are exchanged")] if k == 2 else []
    ways += [(factor * np.eye(k), f"its readings {said}") for said, factor in ANGLE_RATIOS.items()
             if said.endswith("read as degrees")] if k else []  # fmt: skip
    for A, said in ways:
        edits, change = rows.angles(A)
        yield OfTrajectory(
            "table readings", f"table: at the epochs navigated {said}",
            "correct them in table_angles.csv, or navigate with --no-table", "table", (), edits,
        ), change  # fmt: skip
