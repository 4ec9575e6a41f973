"""The survey that does not fit, with the data from which hypotheses are formed; everything costly is found once."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from gtsam import Pose3

from adjust.adjustment import AdjustOptions, adjust
from adjust.graph.assembly import values_of
from adjust.model.boards import deformed
from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment
from adjust.model.survey import Camera, FloatArray, Survey
from adjust.start.lenses import Sighting, start_lens
from adjust.start.views import View, Views, focal_px, joined, make_views, rays_by_block

if TYPE_CHECKING:
    from adjust.diagnosis.score import Linear

CAP = 25.0
"""The most that one component of an observation counts: what is left out, or cannot be predicted, counts so."""
_LEFT_OUT = 4


@dataclass(frozen=True, eq=False)
class Case:
    """A survey, and what became of it: its adjustment, or the error instead. run: how this survey is adjusted."""

    survey: Survey
    result: Adjustment | None = None
    error: SurveyError | None = None
    run: Callable[[Survey], Adjustment] = field(default=adjust)

    @cached_property
    def views(self) -> Mapping[int, View]:
        """Every block of a target with enough points, as rays and poses ``camera_from_target``, each by itself."""
        return {v.block_idx: v for v in single_views(self.survey, self.lenses)}

    @cached_property
    def lenses(self) -> Mapping[str, FloatArray]:
        """The lens (n,) of each camera, from its own images alone; a camera without any is not there."""
        return own_lenses(self.survey)

    @cached_property
    def without_one(self) -> tuple[tuple[tuple[str, str], Adjustment], ...]:
        """(("camera_id" or "target_id", id), adjustment of the survey without its images), where one succeeds.

        Of the few cameras and targets with the largest misfit, or with most images where nothing is adjusted.
        """
        out = []
        for field_name in ("target_id", "camera_id"):
            ids = [t for t in dict.fromkeys(getattr(b, field_name) for b in self.survey.image_blocks) if t is not None]
            for owner in self._worst(field_name, ids)[:_LEFT_OUT] if len(ids) > 1 else ():
                try:
                    out.append(((field_name, owner), self.run(without(self.survey, field_name, owner))))
                except SurveyError:
                    continue
        return tuple(out)

    def _worst(self, field_name: str, ids: list[str]) -> list[str]:
        share = dict.fromkeys(ids, 0.0)
        for block, value in zip(self.survey.image_blocks, self.block_misfit, strict=True):
            owner = getattr(block, field_name)
            if owner in share:
                share[owner] += float(value)
        return sorted(ids, key=lambda owner: -share[owner])

    @cached_property
    def linear(self) -> "Linear | None":
        """The adjustment with all images in use, as a linear system; None where there is none."""
        from adjust.diagnosis.score import Linear  # here: what fails as a whole needs none

        if self.result is None or not self.result.redundancy > 0:
            return None
        if _is_whole(self.survey, self.result):
            return Linear(self.result)
        try:
            return Linear(adjust(self.survey, None, AdjustOptions(reject_blocks=False)))
        except SurveyError:
            return None

    def warm(self, survey: Survey) -> Adjustment:
        """A survey that is much like this one, adjusted from the values of this one; as :attr:`run` does without any.

        SurveyError where that fails.
        """
        linear = self.linear
        start = None if linear is None else values_of(linear.result, survey)
        if start is None or any(c.camera_id not in start.lenses for c in survey.cameras):
            return self.run(survey)
        return adjust(survey, start, AdjustOptions(reject_blocks=False))

    @cached_property
    def block_misfit(self) -> FloatArray:
        """(b,) bounded sum of squares of the image points of each block over their sigmas; all of it, unadjusted."""
        return block_misfits(self.survey, self.result)

    @cached_property
    def error_px(self) -> FloatArray:
        """(b,) rms of what each block shows against its own best pose, px; nan where it has none."""
        out = np.full(len(self.survey.image_blocks), np.nan)
        for i, view in self.views.items():
            out[i] = view.error_px[0]
        return out


def _is_whole(survey: Survey, result: Adjustment) -> bool:
    """Whether every image point and observation in use takes part."""
    given = sum(int(b.mask.sum()) for b in survey.image_blocks)
    return given == int(result.image_residuals.used.sum()) and survey.n_others_used == result.survey.n_others_used


def without(survey: Survey, field_name: str, owner: str) -> Survey:
    """The survey less the images of one camera, or those of one target."""
    blocks = tuple(b for b in survey.image_blocks if getattr(b, field_name) != owner)
    cameras = tuple(c for c in survey.cameras if field_name != "camera_id" or c.camera_id != owner)
    return replace(survey, image_blocks=blocks, cameras=cameras)


def block_misfits(survey: Survey, result: Adjustment | None) -> FloatArray:
    """(b,) bounded sums of squares over sigmas by image block; the bound for what is not adjusted or predicted."""
    out = np.array([2.0 * CAP * len(b.uv) for b in survey.image_blocks])
    if result is None:
        return out
    ptr, residuals = result.image_residuals.block_ptr, result.image_residuals.residuals
    place = {b.place: i for i, b in enumerate(survey.image_blocks)}
    for k, block in enumerate(result.survey.image_blocks):
        r = residuals[ptr[k] : ptr[k + 1]]
        squares = np.einsum("ni,nij,nj->n", r, np.linalg.inv(block.cov), r)
        i = place.get(block.place)
        if i is not None:
            out[i] = np.minimum(np.where(np.isfinite(squares), squares, np.inf), 2.0 * CAP).sum()
    return out


def own_lens(survey: Survey, camera: Camera) -> FloatArray:
    """Start values (n,) of a lens from the camera's images of targets alone; SurveyError where they give none."""
    points = {t.target_id: deformed(t) for t in survey.targets}
    mine = [
        (i, b) for i, b in enumerate(survey.image_blocks)
        if b.camera_id == camera.camera_id and b.target_id is not None
    ]  # fmt: skip
    seen = [Sighting(i, points[str(b.target_id)][b.point_idx[b.mask]], b.uv[b.mask]) for i, b in mine]
    return start_lens(camera, [s for s in seen if len(s.x)]).values


def own_lenses(survey: Survey) -> dict[str, FloatArray]:
    """:func:`own_lens` of every camera whose images give one."""
    found = {}
    for camera in survey.cameras:
        try:
            found[camera.camera_id] = own_lens(survey, camera)
        except SurveyError:
            continue
    return found


def single_views(survey: Survey, lenses: Mapping[str, FloatArray]) -> Views:
    """Every block of a target with three used points or more that has a pose."""
    points = {t.target_id: deformed(t) for t in survey.targets}
    known = replace(survey, cameras=tuple(c for c in survey.cameras if c.camera_id in lenses))
    focal = {c.camera_id: focal_px(c, lenses[c.camera_id]) for c in known.cameras}
    blocks = {i: b for i, b in enumerate(survey.image_blocks) if b.target_id is not None}
    rays, _ = rays_by_block(known, lenses, {i: b.uv[b.mask] for i, b in blocks.items()})
    seen = {i: points[str(blocks[i].target_id)][blocks[i].point_idx[blocks[i].mask]] for i in rays}
    sights = joined([(i, x, rays[i], focal[blocks[i].camera_id]) for i, x in seen.items() if len(x) >= 3])
    return make_views(sights)[0]


def with_lenses(survey: Survey, result: Adjustment) -> Survey:
    """The survey whose lenses start from those of an adjustment."""
    cameras = []
    for camera in survey.cameras:
        value = result.estimates[("lens", camera.camera_id)].value
        cameras.append(camera if isinstance(value, Pose3) else replace(camera, lens=replace(camera.lens, values=value)))
    return replace(survey, cameras=tuple(cameras))
