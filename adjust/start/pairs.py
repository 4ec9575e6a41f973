"""Start values of a survey that is nothing but a network of measured pairs."""

from gtsam import Pose3, Rot3

from adjust.model.result import ParameterName
from adjust.model.survey import Survey
from adjust.start.result import Start


def network_start(survey: Survey) -> Start | None:
    """Averaged rotations and linear positions of the pairs that agree; None where there is more than pairs.

    Surveys of rotations alone, whose positions stay open, are left to the general search, too. Raises
    IndeterminateError naming the stations that no pair ties to the others.
    """
    if not survey.is_pose_network or not any(isinstance(p.b_from_a, Pose3) and p.used for p in survey.pairs):
        return None
    # here: a survey without pairs starts without it
    from adjust.pose_network.from_survey import network_from_survey
    from adjust.pose_network.graduated import graduated_start
    from adjust.pose_network.network import check_determined

    network = network_from_survey(survey, any_datum=True)
    check_determined(network)
    R, t = graduated_start(network)
    notes = (f"{network.n_stations} stations from averaged rotations and linear positions of the pairs that agree",)
    poses: dict[ParameterName, Pose3] = {
        ("world_from_station", s): Pose3(Rot3(R[i]), t[i]) for i, s in enumerate(network.station_ids)
    }
    return Start({}, poses, {}, notes=notes)
