"""What is known, beside what was observed: misfits, scale, place in the world, and blocks that contradict the rest."""

from collections.abc import Mapping

import numpy as np

from adjust.model.survey import FloatArray, Survey
from adjust.native.views import view_offsets
from adjust.spatial.rigid import align
from adjust.start.chains import Chains
from adjust.start.gauge import frames_of, world_is_free
from adjust.start.network import FrameNetwork
from adjust.start.points import scale_lengths
from adjust.start.positions import PointField, Positions
from adjust.start.views import Views, block_text, joined

_OFF = 10.0  # a block this many times worse than the typical one contradicts the others


def block_rms(network: FrameNetwork, chains: Chains, views: Views, points: PointField) -> FloatArray:
    """Robust misfit of every block at the present values: 1.2 times the median offset, px; nan where it has no rays."""
    rms = np.full(len(chains.slots), np.nan)
    world = joined([(s.block_idx, points.x[s.rows], s.rays, s.focal_px) for s in points.sights if len(s.rows)])
    for s in (views.sights, world):
        medians = view_offsets(network.products(chains.part(s.block_idx)), s.x, s.rays, s.ptr)[1]
        # the median of a circular normal's radius is 1.18 sigma, its rms 1.41 sigma
        rms[s.block_idx] = 1.2 * s.focal_px * medians
    return rms


def contradictions(
    survey: Survey, points: PointField, rms: FloatArray, reasons: Mapping[int, str]
) -> dict[int, str]:
    """Reasons against blocks that miss by far where the others put them, beside those set aside before."""
    trusted = np.isfinite(rms)
    trusted[list(reasons)] = False
    # blocks of points that are where a start value puts them are measured by their own kind
    rough = np.zeros(len(rms), dtype=np.bool_)
    rough[[s.block_idx for s in points.sights if points.rough[s.rows].any()]] = True
    typical = np.zeros(len(rms))
    for kind in (rough, ~rough):
        typical[kind] = np.median(rms[trusted & kind]) if (trusted & kind).any() else 0.0
    out: dict[int, str] = {}
    for i in np.flatnonzero(rms > np.maximum(15.0, _OFF * typical)).tolist() if trusted.any() else ():
        if i not in reasons:
            what = "has points behind the camera" if np.isinf(rms[i]) else f"is {rms[i]:.1f} px off"
            text = block_text(survey.image_blocks[i])
            out[i] = f"{text}: {what} where the other blocks put it (typical: {typical[i]:.1f} px)"
    return out


def scaled_to_lengths(survey: Survey, positions: Positions) -> str | None:
    """Give a network of relative orientations the scale of observed distances or coordinates; a note, or None."""
    ratios = []
    for distance in survey.distances:
        ends = positions.of([distance.a, distance.b])
        length = float(np.linalg.norm(ends[distance.a] - ends[distance.b])) if len(ends) == 2 else 0.0
        if distance.used and length > 0.0:
            ratios.append(distance.value / length)
    observed, present = _observed_positions(survey, positions)
    if not ratios and len(observed) > 1:
        ratios = [float(np.std(observed, axis=0).max() / max(np.std(present, axis=0).max(), 1e-12))]
    if not ratios:
        return None
    scale_lengths(positions.network, positions.points, float(np.median(ratios)))
    return f"scale from {len(ratios)} observed length(s)"


def _observed_positions(survey: Survey, positions: Positions) -> tuple[FloatArray, FloatArray]:
    """Observed coordinates (m, 3) and where their positions are at present (m, 3)."""
    rows = []
    for item in survey.coordinates:
        present = positions.of(item.positions) if item.used else {}
        finite = np.all(np.isfinite(np.diag(item.cov)).reshape(-1, 3), axis=1).tolist()
        for ref, value, whole in zip(item.positions, item.values, finite, strict=True):
            if whole and ref in present:
                rows.append((value, present[ref]))
    return np.array([r[0] for r in rows]).reshape(-1, 3), np.array([r[1] for r in rows]).reshape(-1, 3)


def moved_to_coordinates(survey: Survey, positions: Positions) -> str | None:
    """Move the whole world onto observed coordinates where nothing given holds it; a note, or None."""
    network, points = positions.network, positions.points
    if not world_is_free(network, survey) or points.given.any():
        return None
    observed, present = _observed_positions(survey, positions)
    if not len(observed):
        return None
    new_from_old = align(observed, present)
    in_world = [slot for slot, name in enumerate(network.names) if frames_of(network, name)[0] == ("world",)]
    network.pose[in_world] = new_from_old @ network.pose[in_world]
    points.x = points.x @ new_from_old[:3, :3].T + new_from_old[:3, 3]
    return f"world moved onto {len(observed)} observed positions"
