"""Observations that stand in both of two epochs, which are not independent then, as tests between them take them."""

from collections.abc import Hashable, Iterable

from adjust.model.observations import CoordinateDifferences, Distance, ImageBlock, Pair, Reading
from adjust.model.survey import Survey

_Observed = ImageBlock | Pair | CoordinateDifferences | Distance | Reading
_SCALARS = ("distances", "readings")
_MOST, _FEWEST = 0.5, 3
"""Single numbers that were read twice may be the same to the last digit written: only more than this share, of at least
so many, says that they were copied. Of several numbers with all their digits, one observation says so."""


def shared_observations(first: Survey, second: Survey) -> dict[str, int]:
    """How many observations of each kind have the same ids and the same values in both, where that is no chance.

    Given coordinates, table angles and levels are not asked: nominal values of both epochs are rightly the same.
    """
    before, after = _values(first), _values(second)
    found = {kind: sum(weight for key, weight in before[kind].items() if key in after[kind]) for kind in before}
    few = {k for k in _SCALARS if found[k] < max(_FEWEST, _MOST * min(len(before[k]), len(after[k])))}
    return {kind.replace("_", " "): n for kind, n in found.items() if n and kind not in few}


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
