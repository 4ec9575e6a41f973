"""What kind of survey it is, told without what solves it."""

from adjust.model.survey import Survey


def is_pose_network(survey: Survey) -> bool:
    """Whether a survey has nothing but pairs between stations that stay where they are."""
    other = (survey.cameras, survey.image_blocks, survey.table_readings, survey.distances, survey.coordinates,
             survey.readings, survey.coordinate_differences, survey.levels, survey.alignments, survey.laser_spots,
             survey.on_surfaces)  # fmt: skip
    fixed = {s.station_id for s in survey.stations if s.motion == "fixed"}
    ends = [ref for p in survey.pairs for ref in (p.a, p.b)]
    return bool(ends) and not any(other) and all(r.kind == "station" and r.frame_id in fixed for r in ends)
