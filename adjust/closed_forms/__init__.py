"""Solutions without a start: pure functions of arrays, each with the source of its formula."""

from adjust.closed_forms.absolute_pose import (
    PLANAR,
    WIDEST,
    PoseCandidates,
    absolute_pose,
    pose_solutions,
    refine_poses,
    view_errors,
)
from adjust.closed_forms.averaging import mean_pose, mean_rotation, pose_distance
from adjust.closed_forms.hand_eye import (
    degenerate_direction,
    relative_motions,
    solve_ax_xb,
    solve_ax_zb,
    solve_views,
)
from adjust.closed_forms.homography import apply_homography, homography
from adjust.closed_forms.rigid import align, inverse, nearest_rotation, rigid, rotation_exp, rotation_log, transform
from adjust.closed_forms.triangulation import Intersection, intersect
from adjust.closed_forms.zhang import PinholeStart, pinhole_from_homographies, radial_distortion

__all__ = [
    "PLANAR",
    "WIDEST",
    "Intersection",
    "PinholeStart",
    "PoseCandidates",
    "absolute_pose",
    "align",
    "apply_homography",
    "degenerate_direction",
    "homography",
    "intersect",
    "inverse",
    "mean_pose",
    "mean_rotation",
    "nearest_rotation",
    "pinhole_from_homographies",
    "pose_distance",
    "pose_solutions",
    "radial_distortion",
    "refine_poses",
    "relative_motions",
    "rigid",
    "rotation_exp",
    "rotation_log",
    "solve_ax_xb",
    "solve_ax_zb",
    "solve_views",
    "transform",
    "view_errors",
]
