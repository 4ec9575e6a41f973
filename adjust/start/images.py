"""What the images of a survey say by themselves: lenses, poses of targets, rays to points; and which not to trust."""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

import numpy as np

from adjust.frames.lens_states import lenders
from adjust.frames.unknowns import Chain
from adjust.lenses.models import MODELS
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.start.chains import Chains, Observations
from adjust.start.lens.start import start_lens
from adjust.start.positions import PointField, Sight
from adjust.start.views import Sighting, Views, block_text, ends_of, make_views, sightings, sights_of, untrustworthy


@frozen(eq=False)
class Images:
    """lenses: by camera (n,). views: images of targets; sights: of world points. reasons: against blocks, by number."""

    lenses: dict[str, FloatArray]
    views: Views
    sights: list[Sight]
    reasons: dict[int, str]
    notes: list[str]

    def observations(
        self, links: Sequence[Chain], chains: Chains, alternatives: Callable[[int, FloatArray], FloatArray] | None
    ) -> tuple[Observations, Observations]:
        """What views say of the chains of their blocks, those that are trusted and the others; block after block.

        alternatives: of a block and its poses (k, 4, 4) all that it may have.
        """
        blocks, poses, first = self.views.sights.block_idx, self.views.poses, self.views.first
        if alternatives is not None:
            ends = zip(blocks.tolist(), pairwise(first.tolist()), strict=True)
            every = [alternatives(i, poses[a:b]) for i, (a, b) in ends]
            poses, first = np.concatenate([poses[:0], *every]), ends_of([len(own) for own in every])
        mine, rotations = [links[i] for i in blocks.tolist()], np.zeros(len(blocks), dtype=np.bool_)
        seen, order = Observations(mine, chains.part(blocks), poses, first, blocks, rotations), np.argsort(blocks)
        refused = np.isin(blocks[order], list(self.reasons))
        return seen.part(order[~refused]), seen.part(order[refused])


def images_of(survey: Survey, points: PointField, chains: Sequence[Chain]) -> Images:
    """Lenses of all cameras, then rays of all blocks and poses of all targets seen. chains: of every block.

    Raises SurveyError naming the camera whose lens nothing tells; points with a mere start value are released for it
    before.
    """
    blocks = survey.image_blocks
    seen = sightings(survey, points.x)
    rows = {i: b.point_idx[b.used] if b.used is not None else b.point_idx for i, b in enumerate(blocks)
            if b.target_id is None}  # fmt: skip
    lenses, reasons, notes = _lenses(survey, points, seen, rows)
    sights, failed = sights_of(survey.cameras_by_id, lenses, seen)
    at = dict(zip(sights.block_idx.tolist(), range(len(sights)), strict=True))
    in_world = [
        Sight(i, block_text(blocks[i]), row, sights.rays[slice(*sights.ptr[at[i] : at[i] + 2])],
              float(sights.focal_px[at[i]]), chains[i])
        for i, row in rows.items() if i in at
    ]  # fmt: skip
    # fewer than three points give no pose, but may well serve in the adjustment
    three = np.diff(sights.ptr) >= 3
    views, without = make_views(sights.only(three & ~np.isin(sights.block_idx, list(rows))), thorough=False)
    for i, reason in (failed | without).items():
        reasons.setdefault(i, f"{block_text(blocks[i])}: {reason}")
    against, gross = untrustworthy(views, survey, reasons)
    return Images(lenses, views, in_world, {**against, **reasons}, notes + gross)


def _lenses(
    survey: Survey, points: PointField, seen: Mapping[str, Sequence[Sighting]], rows: Mapping[int, IntArray]
) -> tuple[dict[str, FloatArray], dict[int, str], list[str]]:
    """Lens values of every camera, given or from its images of known points; reasons against blocks; notes."""
    blocks, mine = survey.image_blocks, seen
    if rows:
        known = {i: points.known[row] for i, row in rows.items()}
        told = {c: [s if (k := known.get(s.block_idx)) is None else s._replace(x=s.x[k], uv=s.uv[k]) for s in seen[c]]
                for c in seen}  # fmt: skip
        mine = {c: some for c, of in told.items() if (some := [s for s in of if len(s.x)])}
    lenses, reasons, notes = dict[str, FloatArray](), dict[int, str](), list[str]()
    shared, known_of = lenders(survey), dict[tuple[str, str], float]()
    for camera in sorted(survey.cameras, key=lambda c: -len(mine.get(c.camera_id, ())) if shared else 0):
        if camera.camera_id not in mine and camera.lens.values is None and points.release():
            return _lenses(survey, points, seen, rows)  # no target shows it: the points as they are given have to do
        lender, names = shared.get(camera.camera_id, (camera.camera_id, MODELS[camera.lens.model].names))
        lent = {x: known_of[lender, x] for x in names if (lender, x) in known_of}
        found = start_lens(camera, mine.get(camera.camera_id, []), lent)
        lenses[camera.camera_id] = found.values
        values = dict(zip(MODELS[camera.lens.model].names, found.values.tolist(), strict=True))
        known_of.update({(lender, x): values[x] for x in names})
        notes.append(f"camera {camera.camera_id!r}: {found.note}")
        reasons |= {i: f"{block_text(blocks[i])}: {reason}" for i, reason in found.excluded.items()}
    return lenses, reasons, notes
