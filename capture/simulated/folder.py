"""The folder of a simulated laboratory: what the processes that play its parts agree on.

``lab.json`` says how to make it, ``angles.json`` how the table stands now, ``survey.toml`` (and
``observations/coordinates.csv``) is what its owner knows and gives to the session, ``truth.json`` what nobody reads.
"""

import json
import secrets
from dataclasses import asdict
from pathlib import Path

import numpy as np

from adjust.model.errors import SurveyError
from capture.simulated.angles import write_angles
from capture.simulated.laboratory import (
    BEACON_EXPOSURE_US,
    CAMERA_IDS,
    LabPose,
    LabSize,
    SimulatedLab,
    furnished_lab,
    make_lab,
)
from survey.examples.folders import (
    GIVEN,
    camera_text,
    coordinates_text,
    head_on_table,
    spots_text,
    target_text,
    truth_json,
)
from survey.folder.whole import whole_folder

LAB, ANGLES = "lab.json", "angles.json"
_COORDINATES_SIGMA_MM = 0.4
_DEFAULT = LabSize()


def write_lab(folder: Path, seed: int, size: LabSize = _DEFAULT) -> SimulatedLab:
    """Make a laboratory and write its folder, new or empty; the table stands at zero.

    Raises SurveyError where the folder holds something.
    """
    lab = make_lab(seed, size)
    description = {"format": 1, "seed": seed, "poses": [asdict(pose) for pose in lab.poses]}
    with whole_folder(Path(folder)) as place:
        (place / LAB).write_text(json.dumps(description, indent=1) + "\n", encoding="utf-8")
        (place / "truth.json").write_text(truth_json(lab.truth, seed), encoding="utf-8")
        (place / "survey.toml").write_text(_survey_toml(lab), encoding="utf-8")
        if size.n_beacon:
            (place / "observations").mkdir()
            (place / "observations" / "coordinates.csv").write_text(_coordinates(lab), encoding="utf-8")
        write_angles(place / ANGLES, 0.0, 0.0)
    return lab


def read_lab(folder: Path, noise_seed: int | None = None) -> SimulatedLab:
    """The laboratory of a folder, with noise of its own unless ``noise_seed`` says which.

    Raises SurveyError where the folder holds none.
    """
    file = Path(folder) / LAB
    try:
        told = json.loads(file.read_text(encoding="utf-8"))
        poses = (LabPose(**{**pose, "camera_ids": tuple(pose["camera_ids"])}) for pose in told["poses"])
        noise_seed = secrets.randbits(32) if noise_seed is None else noise_seed
        return furnished_lab(int(told["seed"]), tuple(poses), noise_seed)
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise SurveyError(f"{file}: no simulated laboratory ({error}); write one first") from error


def _survey_toml(lab: SimulatedLab) -> str:
    draft = lab.draft
    text = """# A head with three cameras on a two-axis table before a board that hangs in the laboratory: simulated.
format = 1
title = "Simulated laboratory"
"""
    text += "".join(map(camera_text, draft.cameras)) + head_on_table()
    text += "".join(target_text(target, draft.kinds[target.target_id]) for target in draft.targets)
    if draft.points:
        text += "\n" + "\n".join(f"[points.{p.point_id}]" for p in draft.points) + "\n"
        dark = (p.epoch_id for p in lab.poses if p.exposure_us == BEACON_EXPOSURE_US)
        text += spots_text(CAMERA_IDS, dark, 1.5)
    return text + GIVEN


def _coordinates(lab: SimulatedLab) -> str:
    rng = np.random.default_rng((lab.seed, 1))
    true = ((p.point_id, lab.draft.scene().vector("point", p.point_id)) for p in lab.draft.points)
    return coordinates_text(
        ((name, x + 1e-3 * rng.normal(0.0, _COORDINATES_SIGMA_MM, 3)) for name, x in true), _COORDINATES_SIGMA_MM
    )
