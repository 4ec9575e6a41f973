"""A capture plan for people and programs: what ``labcapture run PLAN --dry-run`` prints."""

from typing import Any

import numpy as np

from capture.plan.plan import CapturePlan, check_plan_limits, estimate


def plan_summary(plan: CapturePlan) -> dict[str, Any]:
    """Poses in degrees, counts and seconds. Raises LimitError for a pose that the table cannot take."""
    check_plan_limits(plan)
    time = estimate(plan)
    return {
        "plan": str(plan.file),
        "project": str(plan.project),
        "cameras": {camera.camera_id: camera.address for camera in plan.cameras},
        "table": None if plan.table is None else {"id": plan.table.table_id, "driver": plan.table.driver},
        "axes": [] if plan.table is None else [axis.axis.name for axis in plan.table.axes],
        "poses": {pose.pose_id: np.degrees(pose.angles).round(6).tolist() for pose in plan.poses},
        "repeats": plan.options.repeats,
        "epochs": len(plan.shots),
        "images": len(plan.shots) * len(plan.cameras),
        "seconds": {
            "moving": round(time.moving_s, 1),
            "waiting": round(time.waiting_s, 1),
            "imaging": round(time.imaging_s, 1),
            "total": round(time.total_s, 1),
        },
    }


def plan_text(plan: CapturePlan) -> str:
    """The same for people; all poses, one a line."""
    summary = plan_summary(plan)
    names = summary["axes"]
    lines = ["".join(["pose      ", *(f"{name + ' deg':>14}" for name in names)])]
    for pose_id, angles in summary["poses"].items():
        lines.append("".join([f"{pose_id:<10}", *(f"{angle:14.4f}" for angle in angles)]))
    seconds = summary["seconds"]
    lines += [
        "",
        f"project   {summary['project']}",
        f"cameras   {', '.join(f'{name} at {address}' for name, address in summary['cameras'].items())}",
        f"images    {len(summary['poses'])} poses x {summary['repeats']} repeats x {len(plan.cameras)} cameras = "
        f"{summary['images']}",
        f"time      about {_clock(seconds['total'])} (moving {seconds['moving']:g} s, settling "
        f"{seconds['waiting']:g} s, images {seconds['imaging']:g} s)",
    ]
    if plan.table is not None:
        lines.insert(-2, "limits    all poses are within them: " + _limits(plan))
    return "\n".join(lines)


def _limits(plan: CapturePlan) -> str:
    axes = () if plan.table is None else plan.table.axes
    parts = [
        f"{a.axis.name} {np.degrees(a.axis.lower):g} to {np.degrees(a.axis.upper):g} deg" for a in axes
    ]
    return ", ".join(parts)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s" if minutes else f"{seconds:.1f} s"
