"""Pose networks between g2o files and project folders."""

from pathlib import Path

import numpy as np
from gtsam import Pose3

from adjust.graph.assembly import values_of
from adjust.model.errors import SurveyError
from adjust.model.survey import Survey
from adjust.pose_network.from_survey import network_from_survey
from survey.folder.text import id_problem
from survey.interop.networks.g2o import Information, read_g2o_file, write_g2o
from survey.jobs.adjusting.warm_start import network_poses
from survey.project import AdjustmentOptions, read
from survey.report.results import RESULTS
from survey.solution.earlier.previous import read_previous

AS_IN_THE_FILE = AdjustmentOptions(reject_pairs=False)
"""A file's own minimum is that of all its pairs; its owner may let the program look for wrong ones."""


def survey_from_g2o(
    source: Path, information: Information, block_diagonal: bool = False
) -> tuple[Survey, tuple[str, ...]]:
    """The stations and pairs of a g2o file, and what of it was not taken as it stands, for people.

    Raises SurveyError for what cannot be read, or named in a project.
    """
    found = read_g2o_file(source, information, block_diagonal)
    for station in found.survey.stations:
        if (problem := id_problem(station.station_id)) is not None:
            raise SurveyError(f"{source}: vertex {station.station_id}: {problem}")
    return found.survey, found.notes


def project_to_g2o(source: Path, target: Path, information: Information) -> tuple[int, int, str, tuple[str, ...]]:
    """Write the pairs of a project; number of stations and pairs, which poses were written, what was left out."""
    project = read(source)
    survey = project.survey
    if not survey.is_pose_network or survey.points or survey.targets or survey.tables:
        raise SurveyError(
            f"{source}: g2o holds nothing but poses of fixed stations and pairs between them; this project has more, "
            "or has no pairs"
        )
    network = network_from_survey(survey, any_datum=True)
    adjusted = (source / RESULTS / "solution.json").is_file()
    known = values_of(read_previous(project)).poses if adjusted else _given(survey)
    found = network_poses(survey, known)
    if found is None:
        raise SurveyError(f"{source}: pairs leave stations without a pose; give them a start")
    poses = [found[s] for s in network.station_ids]
    R, t = np.array([p.rotation().matrix() for p in poses]), np.array([p.translation() for p in poses])
    write_g2o(target, network, R, t, information=information)
    which = "adjusted" if adjusted else "start values, not adjusted"
    return network.n_stations, int(network.used.sum()), which, _left_out(survey, network.station_ids)


def _given(survey: Survey) -> dict[tuple[str, ...], Pose3]:
    """Poses that survey.toml gives."""
    return {
        ("world_from_station", s.station_id): s.world_from_station.value
        for s in survey.stations
        if s.world_from_station.value is not None
    }


def _left_out(survey: Survey, ids: tuple[str, ...]) -> tuple[str, ...]:
    """What the file does not say, for people."""
    out = []
    priors = [s.station_id for s in survey.stations if s.world_from_station.treatment == "prior"]
    unused = [p.pair_id for p in survey.pairs if not p.used]
    alone = [s.station_id for s in survey.stations if s.station_id not in ids]
    for what, names in (("priors of stations", priors), ("pairs not in use", unused), ("stations without pair", alone)):
        if names:
            out.append(f"left out, {what}: {', '.join(names[:8])}{' and more' if len(names) > 8 else ''}")
    if not all(s.isascii() and s.isdigit() for s in ids):
        out.append(f"g2o knows only numbers: stations are written as 0 to {len(ids) - 1}, in the order {_order(ids)}")
    return tuple(out)


def _order(ids: tuple[str, ...]) -> str:
    return ", ".join(ids[:12]) + (", ..." if len(ids) > 12 else "")
