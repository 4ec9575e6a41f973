"""Observations with the very values of others, which are not independent: in both of two epochs, or in one survey."""

from collections import Counter
from collections.abc import Hashable, Iterable, Sequence

from adjust.model.observations import CoordinateDifferences, Distance, ImageBlock, Pair, Reading
from adjust.model.survey import Survey

_Observed = ImageBlock | Pair | CoordinateDifferences | Distance | Reading
_SCALARS = ("distances", "readings")
_MOST, _FEWEST = 0.5, 3
"""Single numbers that were read twice may be the same to the last digit written: only more than this share, of at least
so many, says that they were copied. Of several numbers with all their digits, one observation says so."""
_ALMOST_ALL, _SEVERAL = 0.9, 6
"""The same within one survey, where an instrument that shows few digits is read again at once."""
_POINTS = 4
"""Of an image, from which all are the same in another one only if it was copied."""


def shared_observations(first: Survey, second: Survey) -> dict[str, int]:
    """How many observations of each kind have the same ids and the same values in both, where that is no chance.

    Given coordinates, table angles and levels are not asked: nominal values of both epochs are rightly the same.
    """
    before, after = _values(first), _values(second)
    found = {kind: sum(weight for key, weight in before[kind].items() if key in after[kind]) for kind in before}
    few = {k for k in _SCALARS if found[k] < max(_FEWEST, _MOST * min(len(before[k]), len(after[k])))}
    return {kind.replace("_", " "): n for kind, n in found.items() if n and kind not in few}


def copied_observations(survey: Survey) -> dict[str, tuple[tuple[str, str], ...]]:
    """By kind the names of observations of the same with the same values, first and copy, where that is no chance.

    Images of a camera at two epochs, pairs of the same frames; distances and readings of a set-up where almost all that
    were made again came out the same.
    """
    used = [p for p in survey.pairs if p.used]
    ends = Counter((p.a.text, p.b.text) for p in used)
    again = (p for p in used if ends[p.a.text, p.b.text] > 1) if len(ends) < len(used) else ()
    pairs = ((_value(p), p.pair_id) for p in again)
    distances = [((d.a, d.b), d.value, d.distance_id) for d in survey.distances if d.used]
    readings = [((r.kind, r.setup_id, r.at, r.to, r.second), r.value, r.reading_id) for r in survey.readings if r.used]
    found = {"images": _same_images(survey.image_blocks), "pairs": _same(pairs),
             "distances": _same_numbers(distances), "readings": _same_numbers(readings)}  # fmt: skip
    return {kind: names for kind, names in found.items() if names}


def _same(values: Iterable[tuple[Hashable, str]]) -> tuple[tuple[str, str], ...]:
    first = dict[Hashable, str]()
    every = ((first.setdefault(value, name), name) for value, name in values)
    return tuple((a, b) for a, b in every if a != b)


def _same_numbers(every: Sequence[tuple[Hashable, float, str]]) -> tuple[tuple[str, str], ...]:
    often = Counter(value for _, value, _ in every)
    found = _same(((place, value), name) for place, value, name in every if often[value] > 1)
    if len(found) < _SEVERAL:
        return ()
    again = len(every) - len({place for place, _, _ in every})
    return found if len(found) >= _ALMOST_ALL * again else ()


def _same_images(blocks: Sequence[ImageBlock]) -> tuple[tuple[str, str], ...]:
    """Looked at only where the first points of two images are the same."""
    begin = [(b.camera_id, b.target_id, float(b.uv[0, 0])) if len(b.uv) >= _POINTS else None for b in blocks]
    often = Counter(begin)
    some = (b for b, x in zip(blocks, begin, strict=True) if x is not None and often[x] > 1)
    return _same(((b.camera_id, b.target_id, b.uv.tobytes()), f"{b.camera_id}/{b.epoch_id}") for b in some)


def _values(survey: Survey) -> dict[str, dict[Hashable, int]]:
    """Ids and values of the observations of each kind that are used, and how many each stands for."""
    kinds: tuple[tuple[str, Iterable[_Observed]], ...] = (
        ("image_points", survey.image_blocks), ("pairs", survey.pairs), ("distances", survey.distances),
        ("readings", survey.readings), ("coordinate_differences", survey.coordinate_differences))  # fmt: skip
    return {kind: {_value(o): _size(o) for o in found if isinstance(o, ImageBlock) or o.used} for kind, found in kinds}


def _value(o: _Observed) -> Hashable:
    match o:
        case ImageBlock():
            return *o.place, o.uv.tobytes()
        case Pair():
            return o.a.text, o.b.text, o.b_from_a.matrix().tobytes()
        case CoordinateDifferences():
            return o.at, o.to, o.values.tobytes()
        case Distance():
            return o.distance_id, o.a, o.b, o.value
        case Reading():
            return o.reading_id, o.at, o.to, o.value


def _size(o: _Observed) -> int:
    return len(o.uv) if isinstance(o, ImageBlock) else len(o.to) if isinstance(o, CoordinateDifferences) else 1
