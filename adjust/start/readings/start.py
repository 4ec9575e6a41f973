"""Approximate coordinates of points from readings and distances, where none are given."""

from collections import Counter
from collections.abc import Mapping
from statistics import median

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.names import grouped
from adjust.model.observations import PositionRef, position_text
from adjust.model.survey import FloatArray, Survey
from adjust.start.readings.plane import PlaneStart
from adjust.start.readings.sights import (
    Node,
    Sights,
    collect_sights,
    horizon_axes,
    node_of,
    spread,
    spread_differences,
    ties,
)
from adjust.start.readings.space import spread_space
from adjust.start.readings.tilted import tilted_sights


def find_points(
    survey: Survey, known: Mapping[str, FloatArray], frames: Mapping[PositionRef, FloatArray] | None = None
) -> dict[str, FloatArray]:
    """Coordinates (3,) m of all points that known ones, readings, distances and baselines reach.

    known: by point, nan for components not known. frames: of positions in frames that are known. Where nothing is
    known, the first station is the origin and its circle's zero the direction of bearings.
    """
    E = horizon_axes(survey)
    sights = collect_sights(survey)
    nodes = {**known, **{position_text(ref): x for ref, x in (frames or {}).items()}}
    upright = abs(E[2, 2]) > 0.999
    xy, height = {}, {}
    for n, x in nodes.items():
        local = E @ np.nan_to_num(x)
        whole = bool(np.isfinite(x).all())
        if whole or (upright and np.isfinite(x[:2]).all()):
            xy[n] = complex(local[0], local[1])
        if whole or (upright and np.isfinite(x[2])):
            height[n] = float(local[2])
    _baselines(survey, E, xy, height)
    xy, height = _spread(sights, xy, height)
    out = {}
    for point in survey.points:
        n = point.point_id
        if n in xy and n in height:
            x = E.T @ np.array([xy[n].real, xy[n].imag, height[n]])
            given = known.get(n, np.full(3, np.nan))
            out[n] = np.where(np.isfinite(given), given, x)
    return out


def _spread(
    sights: Sights, xy: dict[Node, complex], height: dict[Node, float]
) -> tuple[dict[Node, complex], dict[Node, float]]:
    """Plane coordinates and heights by turns, since slopes need heights and zenith angles need distances."""
    spread_space(sights, xy, height)
    heights_known = bool(height)
    for rough in (False, True):
        for _ in range(3):
            before = len(xy) + len(height)
            height = spread_heights(sights, xy, height, heights_known)
            assumed = dict(height)
            if rough:
                mean = median(height.values()) if height else 0.0
                assumed = dict.fromkeys(sorted(sights.nodes), mean) | height
            found = PlaneStart(sights, sights.distances(assumed)).find(xy)
            xy = xy | found.xy
            height = spread_heights(sights, xy, height, heights_known)
            if len(xy) + len(height) == before:
                break
            if sights.nodes <= xy.keys() & height.keys():
                return xy, height
    return xy, height


def spread_heights(
    sights: Sights, xy: Mapping[Node, complex], known: Mapping[Node, float], seeded: bool
) -> dict[Node, float]:
    """Heights from height differences and zenith angles; the median of all ways of the same length.

    seeded: whether any height was given; else the first one is zero.
    """
    steps = list(sights.rises)
    for (a, b), angles in sights.zenith.items():
        if a in xy and b in xy and xy[a] != xy[b]:
            d = abs(xy[b] - xy[a])
            steps.append((a, b, median([float(d / np.tan(z) + up) for z, up in angles])))
    if not known and not seeded and steps:
        count = Counter(n for a, b, _ in steps for n in (a, b))
        known = {max(count, key=lambda n: (count[n], n)): 0.0}
    return spread(steps, known)


def _baselines(survey: Survey, E: FloatArray, xy: dict[Node, complex], height: dict[Node, float]) -> None:
    """Points at the other end of observed coordinate differences, from the first of them where nothing is known."""
    known = {n: E.T @ np.array([z.real, z.imag, height[n]]) for n, z in xy.items() if n in height}
    between = [a for a, b, _ in ties(survey) if a.frame is None and b.frame is None]
    if between and not xy:
        known = {node_of(between[0]): np.zeros(3)}
    if spread_differences(survey, known):
        for n, x in known.items():
            local = E @ x
            xy[n], height[n] = complex(local[0], local[1]), float(local[2])


def explain(survey: Survey, lacking: list[str]) -> SurveyError:
    """Why these points have no approximate coordinates, by name."""
    sights = collect_sights(survey)
    lost = set(lacking)
    tilted = grouped((s.node, s.setup_id) for mine in tilted_sights(survey).values() for s in mine)
    lines = []
    for n in lacking[:12]:
        directions = sorted({a for a, targets in sights.directions.values() if n in targets})
        directions += sorted({a for a, b in sights.azimuths if b == n})
        near = {b for a, b in (*sights.level, *sights.slope) if a == n} | {
            a for a, b in (*sights.level, *sights.slope) if b == n}  # fmt: skip
        seen = sorted({b for a, targets in sights.directions.values() if a == n for b in targets})
        parts = []
        if directions:
            parts.append(f"{_count(len(directions), 'direction')} from {', '.join(directions[:4])}")
        if near:
            parts.append(f"{_count(len(near), 'distance')} ({', '.join(sorted(near)[:4])})")
        if seen:
            parts.append(f"its own directions to {', '.join(seen[:4])}")
        if n in tilted and not parts:
            from_setups = ", ".join(sorted(set(tilted[n]))[:4])
            lines.append(
                f"point {n!r} is seen from {from_setups}, which {'is' if len(set(tilted[n])) == 1 else 'are'} not "
                "levelled: a second such sight, or a distance, and 3 known points for each station are needed"
            )
            continue
        floating = [m for m in {*directions, *near, *seen} if m in lost]
        also = f"; of these {', '.join(sorted(floating)[:4])} are not known either" if floating else ""
        lines.append(f"point {n!r} is reached by {' and '.join(parts) + ' only' if parts else 'nothing'}{also}")
    more = f"\n  ... and {len(lacking) - 12} more" if len(lacking) > 12 else ""
    return SurveyError(
        f"no start value can be found for {len(lacking)} point(s); measure a distance, a second direction or a height, "
        "or give coordinates:\n  " + "\n  ".join(lines) + more
    )


def _count(n: int, what: str) -> str:
    return f"one {what}" if n == 1 else f"{n} {what}s"
