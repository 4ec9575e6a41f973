"""Image points that are mirrored in all cameras, as where v is counted from the bottom.

Every flat target is then seen from behind and all fits: what is adjusted is the mirror image of what was measured.
"""

from adjust.diagnosis.images import from_behind, is_flat
from adjust.model.errors import listed
from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef
from adjust.model.result import Adjustment
from survey.project import Project
from survey.project.targets import PointList
from survey.solution.frames import AdjustedFrames

_FEWEST, _LOOKED_AT = 3, 12
"""Images of a camera by which it is judged, and at how many one looks."""


@frozen
class Sides:
    """From where cameras see printed flat targets. behind: how many images of cameras that see none from its front."""

    behind: dict[str, int]
    some_from_front: bool


def sides(project: Project, result: Adjustment) -> Sides:
    """By the first images of every camera."""
    survey = result.survey
    printed = {t for t, kind in project.target_kinds.items() if not isinstance(kind, PointList)}
    flat = {t.target_id: t.x_in_target for t in survey.targets if t.target_id in printed and is_flat(t.x_in_target)}
    if not flat:
        return Sides({}, False)
    frames, seen = AdjustedFrames(result), dict[str, list[bool]]()
    for block in survey.image_blocks:
        mine = seen.setdefault(block.camera_id, [])
        if block.target_id is None or block.target_id not in flat or not block.n_used or len(mine) >= _LOOKED_AT:
            continue
        camera = frames.world_from(FrameRef("camera", block.camera_id, block.epoch_id))
        target = frames.world_from(FrameRef("target", block.target_id, block.epoch_id))
        if camera is not None and target is not None:
            mine.append(from_behind((camera.inverse() * target).matrix(), flat[block.target_id]))
    behind = {c: len(mine) for c, mine in seen.items() if len(mine) >= _FEWEST and all(mine)}
    return Sides(behind, not all(x for mine in seen.values() for x in mine))


def mirrored_warnings(project: Project, result: Adjustment) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """For people: which cameras' images are mirrored for sure, and what may be mirrored as a whole."""
    found = sides(project, result)
    if not found.behind:
        return (), ()
    n, cameras = sum(found.behind.values()), listed(list(found.behind), 6)
    if found.some_from_front:
        return (
            f"images of {cameras} are mirrored: all {n} that were looked at show flat targets from behind, those of "
            "other cameras do not; count v_px from the top in image_points.csv and spots.csv, or mirror the images "
            "back",
        ), ()  # fmt: skip
    return (), (
        f"all {n} images of flat targets that were looked at show them from behind: where v_px counts from the bottom, "
        "or images are mirrored, all of this is the mirror image of what was measured; count v_px from the top, or "
        "mirror the images back. Where only the rows of the targets are counted from the other end, no more than their "
        "own axes is wrong",
    )  # fmt: skip
