"""The observations of a project by the names under which they are left out, and what each name means."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from adjust.model.observations import (
    CoordinateDifferences,
    Coordinates,
    FrameRef,
    ImageBlock,
    Observation,
    PositionRef,
)
from adjust.model.result import ObservationResidual
from adjust.model.survey import BoolArray, Survey
from survey.project.detected import ImageKey
from survey.project.exclusions import Exclusion, Name, name_problem
from survey.project.project import LeftOut, SpotBlock
from survey.project.tables.kinds import KINDS

Ref = PositionRef | FrameRef | str
"""What an observation names: a position, a frame, an epoch."""
Place = tuple[str, int]
"""An observation: field of the survey, or ``SPOTS``, and position in it."""
IMAGES, SPOTS = "image_blocks", "spots"
CALLED = {name: kind for kind in KINDS for name in (kind.layout.name, *kind.called)}
"""The kinds of observations as tables and reports call them."""
_NEAR_PX = 3.0  # detection may move a spot by noise and a new threshold, but not onto another one


@dataclass(eq=False)
class Hits:
    """What a name means: which rows of which observations, as masks.

    masks: by place, that is by field of the survey (``SPOTS`` for spots that have no name yet) and position in it;
    sets of coordinates and of differences have several rows, other readings one.
    """

    masks: dict[Place, BoolArray] = field(default_factory=dict)

    def add(self, place: Place, mask: BoolArray) -> None:
        """These rows too."""
        if mask.any():
            self.masks[place] = self.masks[place] | mask if place in self.masks else mask

    def add_whole(self, place: Place, n: int) -> None:
        """All n rows of an observation."""
        if n:
            self.masks[place] = np.ones(n, dtype=np.bool_)

    def of(self, field_name: str) -> dict[int, BoolArray]:
        """The masks of one field, by position."""
        return {i: mask for (name, i), mask in self.masks.items() if name == field_name}

    @property
    def n(self) -> int:
        """Number of observations: image points, spots and readings."""
        return self.n_image_points + self.n_spots + self.n_readings

    @property
    def n_image_points(self) -> int:
        """Number of image points."""
        return sum(int(mask.sum()) for mask in self.of(IMAGES).values())

    @property
    def n_spots(self) -> int:
        """Number of spots that have no name yet."""
        return sum(int(mask.sum()) for mask in self.of(SPOTS).values())

    @property
    def n_readings(self) -> int:
        """Number of observations that are no image points, a set counted once."""
        return sum(name not in (IMAGES, SPOTS) for name, _ in self.masks)

    def __bool__(self) -> bool:
        return bool(self.masks)

    def text(self) -> str:
        """The counts, for people."""
        counts = (self.n_readings, "reading"), (self.n_image_points, "image point"), (self.n_spots, "spot")
        n_images = len(self.of(IMAGES))
        where = f" in {n_images} image{'s' * (n_images != 1)}" if n_images else ""
        return ", ".join(f"{n} {what}{'s' * (n != 1)}" for n, what in counts if n) + where or "nothing"

    def left_out(self, exclusion: Exclusion) -> LeftOut:
        """An exclusion that means this, in force."""
        return LeftOut(exclusion, len(self.of(IMAGES)), self.n_image_points, self.n_spots, self.n_readings)


class Observed:
    """All observations of a project, by name. ``spots``: those that have no name yet.

    readings: the places of each name ``table:id``. points: positions of points by target, None for the world.
    """

    def __init__(self, survey: Survey, spots: Sequence[SpotBlock]) -> None:
        self.survey, self.spots = survey, tuple(spots)
        self.readings: dict[str, list[Place]] = {}
        for kind in KINDS:
            for i, item in enumerate(getattr(survey, kind.field)):
                self.readings.setdefault(f"{kind.layout.name}:{kind.id_of(item)}", []).append((kind.field, i))
        self.points: dict[str | None, dict[str, int]] = {
            t.target_id: {p: i for i, p in enumerate(t.point_ids)} for t in survey.targets
        }
        self.points[None] = {p.point_id: i for i, p in enumerate(survey.points)}
        self._blocks, self._spots = _by_image(survey.image_blocks), _by_image(self.spots)

    def hits(self, name: Name, at: tuple[float, float] | None = None) -> Hits:
        """What a name means here; nothing where there is no such thing. at: where the spot of that name was, px."""
        found = Hits()
        if name_problem(name.what, name.id) is not None:
            return found
        if name.what == "reading":
            for which, i in self.readings.get(name.id, []):
                found.add_whole((which, i), len(_rows(getattr(self.survey, which)[i])))
            return found
        meant = name.meant
        if name.what != "spot":
            self._in_images(found, meant)
        if name.what in ("image", "epoch", "camera", "spot"):
            self._in_spots(found, meant, at)
        if name.what == "epoch":
            self._others_where(found, lambda ref: ref == name.id or _frame(ref).epoch_id == name.id)
        if name.what == "point" and "target" not in meant and name.id in self.points[None]:
            self._others_where(found, lambda ref: isinstance(ref, PositionRef) and ref.frame is None
                               and ref.point_id == name.id)  # fmt: skip
        return found

    def _in_images(self, found: Hits, meant: Mapping[str, str]) -> None:
        """Image points of a camera, an epoch, a target; of one point of a target, or of the world where it has none."""
        camera, epoch, target, point = (meant.get(key) for key in ("camera", "epoch", "target", "point"))
        of_any = target is None and point is None
        index = None if point is None else self.points.get(target, {}).get(point, -1)
        for i in self._at(self._blocks, camera, epoch, len(self.survey.image_blocks)):
            block = self.survey.image_blocks[i]
            if not _is_of(block, camera, epoch) or not (of_any or block.target_id == target):
                continue
            if index is None:
                found.add_whole((IMAGES, i), len(block.uv))
            else:
                found.add((IMAGES, i), block.point_idx == index)

    def _in_spots(self, found: Hits, meant: Mapping[str, str], at: tuple[float, float] | None) -> None:
        """Spots of a camera, an epoch; or the one of a name, by where it was if that is known."""
        camera, epoch, spot = (meant.get(key) for key in ("camera", "epoch", "spot"))
        for i in self._at(self._spots, camera, epoch, len(self.spots)):
            block = self.spots[i]
            if not _is_of(block, camera, epoch):
                continue
            if spot is None:
                found.add_whole((SPOTS, i), len(block.uv))
            elif at is None:
                found.add((SPOTS, i), np.array([one == spot for one in block.spot_ids], dtype=np.bool_))
            else:
                far = np.linalg.norm(block.uv - np.array(at), axis=1)
                found.add((SPOTS, i), np.asarray(far <= min(_NEAR_PX, far.min(initial=np.inf))))

    @staticmethod
    def _at(by_image: Mapping[ImageKey, list[int]], camera: str | None, epoch: str | None, n: int) -> Sequence[int]:
        """Where to look for what was seen by a camera at an epoch: of one image at once."""
        return range(n) if camera is None or epoch is None else by_image.get((camera, epoch), [])

    def _others_where(self, found: Hits, wanted: Callable[[Ref], bool]) -> None:
        for name, items in self.survey.others.items():
            for i, item in enumerate(items):
                found.add((name, i), np.array([any(map(wanted, refs)) for refs in _rows(item)], dtype=np.bool_))

    def is_used(self, name: Name) -> bool:
        """Whether any observation of a name is in use."""
        return any(
            which == SPOTS or bool((mask & getattr(self.survey, which)[i].mask).any() if which == IMAGES
                                   else getattr(self.survey, which)[i].used)
            for (which, i), mask in self.hits(name).masks.items()
        )  # fmt: skip

    def covers(self, wide: Name, name: Name) -> bool:
        """Whether a name means everything that another one means."""
        a, b = self.hits(wide).masks, self.hits(name).masks
        return all(place in a and not (mask & ~a[place]).any() for place, mask in b.items())

    def place_of(self, name: Name) -> tuple[float, float] | None:
        """Where a spot is (px), None for what is no spot."""
        for i, mask in self.hits(name).of(SPOTS).items() if name.what == "spot" else ():
            u, v = self.spots[i].uv[mask][0].tolist()
            return float(u), float(v)
        return None

    def names(self, hit: Hits) -> list[str]:
        """The readings of a hit by name, sets that are hit as a whole."""
        wanted = {place for place, mask in hit.masks.items() if mask.all()}
        return [name for name, places in self.readings.items() if wanted.intersection(places)]


def _frame(ref: Ref) -> FrameRef:
    """The frame of a reference; the world for what is none."""
    if isinstance(ref, PositionRef):
        return ref.frame or FrameRef("world")
    return ref if isinstance(ref, FrameRef) else FrameRef("world")


def name_of_residual(residual: ObservationResidual) -> str:
    """The name of an observation of ``Adjustment.other_residuals``: ``table:id``."""
    return name_of_observation(residual.kind, residual.ids)


def name_of_observation(kind: str, ids: Sequence[str]) -> str:
    """The same by its kind and ids."""
    whole = kind in ("table", "coordinates", "surface")  # the others carry their id in front of what they join
    table = CALLED[kind].layout.name if kind in CALLED else kind
    return f"{table}:{'/'.join(ids) if whole else ids[0]}"


def _rows(item: Observation) -> list[list[Ref]]:
    """The positions and frames that each row of an observation names, and its epoch; one row but for sets."""
    if isinstance(item, Coordinates):
        return [[ref] for ref in item.positions]
    if isinstance(item, CoordinateDifferences):
        return [[a, b] for a, b in zip(item.at, item.to, strict=True)]
    values = (getattr(item, name, None) for name in ("a", "b", "at", "to", "second", "position", "frame", "epoch_id"))
    return [[value for value in values if value is not None]]


def union(hits: Iterable[Hits]) -> Hits:
    """All that any of them means, each once."""
    out = Hits()
    for place, mask in (item for hit in hits for item in hit.masks.items()):
        out.add(place, mask)
    return out


def _by_image(seen: Iterable[ImageBlock | SpotBlock]) -> dict[ImageKey, list[int]]:
    found: dict[ImageKey, list[int]] = {}
    for i, block in enumerate(seen):
        found.setdefault((block.camera_id, block.epoch_id), []).append(i)
    return found


def _is_of(block: ImageBlock | SpotBlock, camera: str | None, epoch: str | None) -> bool:
    return camera in (None, block.camera_id) and epoch in (None, block.epoch_id)
