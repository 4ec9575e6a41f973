"""Solutions without a start: pure functions of arrays, each with the source of its formula."""

from adjust.closed_forms.absolute_pose import best_poses, pose_solutions, view_poses
from adjust.closed_forms.averaging import mean_pose, pose_distance
from adjust.closed_forms.hand_eye import (
    degenerate_direction,
    relative_motions,
    solve_ax_xb,
    solve_ax_zb,
    solve_views,
)
from adjust.closed_forms.rigid import align, inverse, nearest_rotation, rigid, rotation_exp, rotation_log, transform
from adjust.closed_forms.triangulation import Intersection, intersect
from adjust.closed_forms.zhang import PinholeStart, pinhole_from_homographies
from adjust.native.views import homographies, plane_poses, refine_poses, view_errors, view_offsets

__all__ = [
    "Intersection",
    "PinholeStart",
    "align",
    "best_poses",
    "degenerate_direction",
    "homographies",
    "intersect",
    "inverse",
    "mean_pose",
    "nearest_rotation",
    "pinhole_from_homographies",
    "plane_poses",
    "pose_distance",
    "pose_solutions",
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
    "view_offsets",
    "view_poses",
]
