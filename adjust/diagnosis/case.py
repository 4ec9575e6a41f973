"""The survey that does not fit, with the data from which hypotheses are formed; everything costly is found once."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from gtsam import Pose3

from adjust.adjustment import adjust
from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, Survey
from adjust.start.lenses import Sighting, start_lens
from adjust.start.views import Sight, View, all_rays, focal_px, make_views, refine_views, target_points, used_rows


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
        return single_views(self.survey, self.lenses)

    @cached_property
    def lenses(self) -> Mapping[str, FloatArray]:
        """The lens (n,) of each camera, from its own images alone; a camera without any is not there."""
        return own_lenses(self.survey)

    @cached_property
    def error_px(self) -> FloatArray:
        """(b,) rms of what each block shows against its own best pose, px; nan where it has none."""
        out = np.full(len(self.survey.image_blocks), np.nan)
        for i, view in self.views.items():
            out[i] = view.error_px[0]
        return out


def own_lenses(survey: Survey) -> dict[str, FloatArray]:
    """Start values of lenses (n,) by camera, from the images of targets of each camera alone."""
    points = {t.target_id: target_points(t) for t in survey.targets}
    found = {}
    for camera in survey.cameras:
        blocks = [
            (i, b) for i, b in enumerate(survey.image_blocks)
            if b.camera_id == camera.camera_id and b.target_id is not None
        ]  # fmt: skip
        seen = [Sighting(i, points[str(b.target_id)][b.point_idx[used_rows(b)]], b.uv[used_rows(b)]) for i, b in blocks]
        try:
            found[camera.camera_id] = start_lens(camera, [s for s in seen if len(s.x)]).values
        except SurveyError:
            continue
    return found


def single_views(survey: Survey, lenses: Mapping[str, FloatArray]) -> dict[int, View]:
    """Every block of a target with three used points or more that has a pose, by its position."""
    points = {t.target_id: target_points(t) for t in survey.targets}
    cameras = {c.camera_id: c for c in survey.cameras}
    known = replace(
        survey,
        image_blocks=tuple(b for b in survey.image_blocks if b.camera_id in lenses),
    )
    where = [i for i, b in enumerate(survey.image_blocks) if b.camera_id in lenses]
    rays, _ = all_rays(known, dict(lenses))
    sights = []
    for k, i in enumerate(where):
        block = survey.image_blocks[i]
        used = used_rows(block)
        if block.target_id is not None and k in rays and used.sum() >= 3:
            x = points[block.target_id][block.point_idx[used]]
            sights.append(Sight(i, x, rays[k][used], focal_px(cameras[block.camera_id], lenses[block.camera_id])))
    return {v.block_idx: v for v in refine_views(make_views(sights)[0])}


def with_lenses(survey: Survey, result: Adjustment) -> Survey:
    """The survey whose lenses start from those of an adjustment."""
    cameras = []
    for camera in survey.cameras:
        value = result.estimates[("lens", camera.camera_id)].value
        cameras.append(camera if isinstance(value, Pose3) else replace(camera, lens=replace(camera.lens, values=value)))
    return replace(survey, cameras=tuple(cameras))
