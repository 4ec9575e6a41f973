"""The observations of a project by the names under which they are left out, and what each name means."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.observations import (
    CoordinateDifferences,
    Coordinates,
    FrameRef,
    ImageBlock,
    Observation,
    PositionRef,
    position_text,
)
from adjust.model.result import ObservationResidual
from adjust.model.survey import BoolArray, Survey
from survey.folder.text import suggestion
from survey.project.exclusions import WHAT, Name, name_problem
from survey.project.project import SpotBlock
from survey.project.tables.kinds import KINDS

Ref = PositionRef | FrameRef | str
"""What an observation names: a position, a frame, an epoch."""
_KINDS = {name: kind for kind in KINDS for name in (kind.layout.name, *kind.called)}  # as tables and reports call them
_NEAR_PX = 3.0  # detection may move a spot by noise and a new threshold, but not onto another one


@dataclass(eq=False)
class Hits:
    """What a name means: image points (a mask by block), spots (ids by block), others by field of the survey.

    members: of sets of coordinates and of differences only these rows, by field and position.
    """

    images: dict[int, BoolArray] = field(default_factory=dict)
    spots: dict[int, set[str]] = field(default_factory=dict)
    others: dict[str, set[int]] = field(default_factory=dict)
    members: dict[tuple[str, int], set[int]] = field(default_factory=dict)

    @property
    def n(self) -> int:
        """Number of observations: image points, spots and readings."""
        return self.n_image_points + self.n_spots + self.n_readings

    @property
    def n_image_points(self) -> int:
        """Number of image points."""
        return sum(int(mask.sum()) for mask in self.images.values())

    @property
    def n_spots(self) -> int:
        """Number of spots that have no name yet."""
        return sum(len(ids) for ids in self.spots.values())

    @property
    def n_readings(self) -> int:
        """Number of observations that are no image points."""
        return sum(len(rows) for rows in self.others.values()) + len(self.members)

    def __bool__(self) -> bool:
        return bool(self.images or self.spots or self.others or self.members)

    def text(self) -> str:
        """The counts, for people."""
        counts = (self.n_readings, "reading"), (self.n_image_points, "image point"), (self.n_spots, "spot")
        n_images = len(self.images)
        where = f" in {n_images} image{'s' * (n_images != 1)}" if n_images else ""
        return ", ".join(f"{n} {what}{'s' * (n != 1)}" for n, what in counts if n) + where or "nothing"


class Observed:
    """All observations of a project, by name. ``spots``: those that have no name yet."""

    def __init__(self, survey: Survey, spots: Sequence[SpotBlock]) -> None:
        self.survey, self.spots = survey, tuple(spots)
        self.readings: dict[str, list[tuple[str, int]]] = {}
        for kind in KINDS:
            for i, item in enumerate(getattr(survey, kind.field)):
                self.readings.setdefault(f"{kind.layout.name}:{kind.id_of(item)}", []).append((kind.field, i))
        self._target_points = {t.target_id: {p: i for i, p in enumerate(t.point_ids)} for t in survey.targets}
        self._points = {p.point_id: i for i, p in enumerate(survey.points)}
        self._blocks: dict[tuple[str, str], list[int]] = {}
        for i, block in enumerate(survey.image_blocks):
            self._blocks.setdefault((block.camera_id, block.epoch_id), []).append(i)
        self._spots: dict[tuple[str, str], list[int]] = {}
        for i, spot in enumerate(self.spots):
            self._spots.setdefault((spot.camera_id, spot.epoch_id), []).append(i)

    def hits(self, name: Name, at: tuple[float, float] | None = None) -> Hits:
        """What a name means here; nothing where there is no such thing. at: where the spot of that name was, px."""
        if name_problem(name.what, name.id) is not None:
            return Hits()
        found = Hits()
        getattr(self, f"_{name.what}")(found, *((name.id,) if name.what == "point" else name.parts),
                                       **({"at": at} if name.what == "spot" else {}))  # fmt: skip
        return found

    def _mask(self, found: Hits, i: int, mask: BoolArray) -> None:
        if mask.any():
            found.images[i] = found.images[i] | mask if i in found.images else mask

    def _blocks_where(self, found: Hits, wanted: Callable[[ImageBlock], bool]) -> None:
        for i, block in enumerate(self.survey.image_blocks):
            if wanted(block):
                self._mask(found, i, np.ones(len(block.uv), dtype=np.bool_))

    def _image_point(self, found: Hits, camera: str, epoch: str, *rest: str) -> None:
        target, point = (rest[0], rest[1]) if len(rest) == 2 else (None, rest[0])
        index = (self._points if target is None else self._target_points.get(target, {})).get(point)
        for i in self._blocks.get((camera, epoch), []) if index is not None else []:
            block = self.survey.image_blocks[i]
            if block.target_id == target:
                self._mask(found, i, block.point_idx == index)

    def _spots_of(self, found: Hits, which: Iterable[int]) -> None:
        found.spots.update((i, set(self.spots[i].spot_ids)) for i in which)

    def _image(self, found: Hits, camera: str, epoch: str) -> None:
        for i in self._blocks.get((camera, epoch), []):
            self._mask(found, i, np.ones(len(self.survey.image_blocks[i].uv), dtype=np.bool_))
        self._spots_of(found, self._spots.get((camera, epoch), []))

    def _target(self, found: Hits, *parts: str) -> None:
        place = parts[:2] if len(parts) == 3 else None
        self._blocks_where(
            found, lambda b: b.target_id == parts[-1] and place in (None, (b.camera_id, b.epoch_id))
        )

    def _point(self, found: Hits, text: str) -> None:
        target, _, point = text.rpartition("/")
        known = self._target_points.get(target, {}) if target else self._points
        index = known.get(point)
        for i, block in enumerate(self.survey.image_blocks) if index is not None else ():
            if block.target_id == (target or None):
                self._mask(found, i, block.point_idx == index)
        if not target and index is not None:
            self._others_where(found, lambda ref: isinstance(ref, PositionRef) and ref.frame is None
                               and ref.point_id == point)  # fmt: skip

    def _epoch(self, found: Hits, epoch: str) -> None:
        self._blocks_where(found, lambda b: b.epoch_id == epoch)
        self._spots_of(found, (i for i, spot in enumerate(self.spots) if spot.epoch_id == epoch))
        self._others_where(found, lambda ref: ref == epoch or _frame(ref).epoch_id == epoch)

    def _camera(self, found: Hits, camera: str) -> None:
        self._blocks_where(found, lambda b: b.camera_id == camera)
        self._spots_of(found, (i for i, spot in enumerate(self.spots) if spot.camera_id == camera))

    def _reading(self, found: Hits, table: str, name: str) -> None:
        for which, i in self.readings.get(f"{table}:{name}", []):
            found.others.setdefault(which, set()).add(i)

    def _spot(
        self, found: Hits, camera: str, epoch: str, spot: str, *, at: tuple[float, float] | None
    ) -> None:
        for i in self._spots.get((camera, epoch), []):
            block = self.spots[i]
            if at is not None:
                far = np.linalg.norm(block.uv - np.array(at), axis=1)
                if len(far) and far.min() <= _NEAR_PX:
                    found.spots[i] = {block.spot_ids[int(far.argmin())]}
            elif spot in block.spot_ids:
                found.spots[i] = {spot}

    def _others_where(self, found: Hits, wanted: Callable[[Ref], bool]) -> None:
        for name, items in self.survey.others.items():
            for i, item in enumerate(items):
                rows = _rows(item)
                mine = {k for k, refs in enumerate(rows) if any(wanted(ref) for ref in refs)}
                if len(mine) == len(rows):
                    found.others.setdefault(name, set()).add(i)
                elif mine and len(rows) > 1:
                    found.members[name, i] = mine

    def is_used(self, name: Name) -> bool:
        """Whether any observation of a name is in use."""
        hit, blocks = self.hits(name), self.survey.image_blocks
        images = (mask if (used := blocks[i].used) is None else mask & used for i, mask in hit.images.items())
        others = (getattr(self.survey, which)[i].used for which, rows in hit.others.items() for i in rows)
        members = (getattr(self.survey, which)[i].used for which, i in hit.members)
        return bool(hit.spots) or any(m.any() for m in images) or any(others) or any(members)

    def covers(self, wide: Name, name: Name) -> bool:
        """Whether a name means everything that another one means."""
        a, b = self.hits(wide), self.hits(name)
        return (
            all(i in a.images and not (mask & ~a.images[i]).any() for i, mask in b.images.items())
            and all(rows <= a.others.get(which, set()) for which, rows in b.others.items())
            and all(ids <= a.spots.get(i, set()) for i, ids in b.spots.items())
            and all(rows <= a.members.get(place, set()) for place, rows in b.members.items())
        )

    def place_of(self, name: Name) -> tuple[float, float] | None:
        """Where a spot is (px), None for what is no spot."""
        if name.what != "spot":
            return None
        camera, epoch, spot = name.parts
        for i in self._spots.get((camera, epoch), []):
            if spot in self.spots[i].spot_ids:
                u, v = self.spots[i].uv[self.spots[i].spot_ids.index(spot)].tolist()
                return float(u), float(v)
        return None

    def names(self, hit: Hits) -> list[str]:
        """The readings of a hit by name."""
        wanted = {(field_name, i) for field_name, rows in hit.others.items() for i in rows}
        return [name for name, places in self.readings.items() if wanted.intersection(places)]

    def known(self, what: str) -> list[str]:
        """Ids that there are of a kind; for messages."""
        blocks, targets = self.survey.image_blocks, self._target_points
        if what == "reading":
            return list(self.readings)
        if what == "image_point":
            return [f"{b.camera_id}/{b.epoch_id}/{f'{b.target_id}/' if b.target_id else ''}{p}"
                    for b in blocks for p in self._names_in(b)]  # fmt: skip
        places = [*((b.camera_id, b.epoch_id) for b in blocks), *((s.camera_id, s.epoch_id) for s in self.spots)]
        found: dict[str, Iterable[str]] = {
            "image": (f"{c}/{e}" for c, e in places),
            "target": (*targets, *(f"{b.camera_id}/{b.epoch_id}/{b.target_id}" for b in blocks if b.target_id)),
            "point": (*self._points, *(f"{t}/{p}" for t, points in targets.items() for p in points)),
            "epoch": (*(e for _, e in places), *(r.epoch_id for r in self.survey.table_readings)),
            "camera": (c.camera_id for c in self.survey.cameras),
            "spot": (f"{s.camera_id}/{s.epoch_id}/{one}" for s in self.spots for one in s.spot_ids),
        }
        return list(dict.fromkeys(found[what]))

    def _names_in(self, block: ImageBlock) -> list[str]:
        if block.target_id is None:
            return [self.survey.points[int(i)].point_id for i in block.point_idx]
        points = next(t.point_ids for t in self.survey.targets if t.target_id == block.target_id)
        return [points[int(i)] for i in block.point_idx]

    def near(self, name: Name) -> str:
        """What to do about a name that means nothing: the nearest that does."""
        known = self.known(name.what)
        if name.what == "image_point":  # of the same image or point first: there are too many to compare
            parts = name.parts
            known = [k for k in known if k.split("/")[:2] == list(parts[:2]) or k.split("/")[-1] == parts[-1]][:2000]
        return suggestion(name.id, known)

    def find(self, text: str) -> Name:
        """The name that a person means: with its kind (``image:X/h05``), as reports call it, or bare where one fits.

        A reading goes before a point, an epoch before the readings of a table at that epoch. Raises SurveyError for
        what is unknown or may mean several things.
        """
        prefix, colon, rest = text.partition(":")
        names = [Name("reading", text)] if text in self.readings else []
        if colon and not names:
            names = [n for n in self._with_kind(prefix, rest) if self.hits(n)]
        bare = () if names else self._bare(text)
        for group in bare:
            names = [n for n in group if self.hits(n)]
            if names:
                break
        if len(names) == 1:
            return names[0]
        if names:
            raise SurveyError(f"{text!r} stands for {' and '.join(map(str, names[:6]))}"
                              f"{' and more' if len(names) > 6 else ''}; name one of them so")  # fmt: skip
        raise SurveyError(f"nothing that was observed has the name {text!r}; {self._meant(prefix, colon, rest, text)}")

    def _with_kind(self, prefix: str, rest: str) -> list[Name]:
        if prefix == "reading":
            return [Name("reading", rest)]
        if prefix in WHAT:
            return [Name(prefix, rest)] if name_problem(prefix, rest) is None else []
        kind = _KINDS.get(prefix)
        return [] if kind is None else [Name("reading", f"{kind.layout.name}:{rest}")]

    def _bare(self, text: str) -> tuple[list[Name], ...]:
        """Groups of names that a bare text may stand for; the first group in which any means something counts."""
        named = (f"{kind.layout.name}:{text}" for kind in KINDS)
        readings = [Name("reading", name) for name in named if name in self.readings]
        n = text.count("/") + 1
        if n > 1:
            shapes = {2: ("image", "point"), 3: ("image_point", "target", "spot"), 4: ("image_point",)}.get(n, ())
            return readings, [Name(what, text) for what in shapes]
        wide = [Name(what, text) for what in ("epoch", "camera", "target")]
        points = [Name("point", text)] if text in self._points else []
        points += [Name("point", f"{t}/{text}") for t, known in self._target_points.items() if text in known]
        return readings, wide, points

    def _meant(self, prefix: str, colon: str, rest: str, text: str) -> str:
        if colon and (named := self._with_kind(prefix, rest)):
            if named[0].what != "reading":
                return self.near(named[0])
            table = named[0].id.partition(":")[0]
            return suggestion(rest, (k.partition(":")[2] for k in self.readings if k.startswith(f"{table}:")))
        if colon and prefix in WHAT:
            return str(name_problem(prefix, rest)).removeprefix("id: ")
        bare = [k.partition(":")[2] for k in self.readings]
        for what in ("epoch", "camera", "target", "image", "point"):
            bare += self.known(what)
        bare += [p for points in self._target_points.values() for p in points]
        return suggestion(text, bare)

    def by_member(self, text: str) -> str | None:
        """The set of coordinates to which a position belongs that is no observation by itself; None for others."""
        name = text.removeprefix("coordinates:")
        for item in self.survey.coordinates:
            if item.set_id and name in map(position_text, item.positions):
                return str(item.set_id)
        return None


def _frame(ref: Ref) -> FrameRef:
    """The frame of a reference; the world for what is none."""
    if isinstance(ref, PositionRef):
        return ref.frame or FrameRef("world")
    return ref if isinstance(ref, FrameRef) else FrameRef("world")


def name_of_residual(residual: ObservationResidual) -> str:
    """The name of an observation of ``Adjustment.other_residuals``: ``table:id``."""
    whole = residual.kind in ("table", "coordinates", "surface")  # the others carry their id in front of what they join
    table = _KINDS[residual.kind].layout.name if residual.kind in _KINDS else residual.kind
    return f"{table}:{'/'.join(residual.ids) if whole else residual.ids[0]}"


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
    for hit in hits:
        for i, mask in hit.images.items():
            out.images[i] = out.images[i] | mask if i in out.images else mask
        for name, rows in hit.others.items():
            out.others.setdefault(name, set()).update(rows)
        for i, ids in hit.spots.items():
            out.spots.setdefault(i, set()).update(ids)
        for place, parts in hit.members.items():
            out.members.setdefault(place, set()).update(parts)
    out.members = {(name, i): rows for (name, i), rows in out.members.items() if i not in out.others.get(name, ())}
    return out
