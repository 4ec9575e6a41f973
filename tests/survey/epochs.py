"""Epochs of a small stereo survey for tests of batches: the same cameras each night with fresh noise."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from adjust.model.survey import Survey
from survey.project import write_project
from survey.simulate import resample, stereo


def epoch_survey(seed: int, *, n_pairs: int = 5, shift_px: float = 0.0) -> Survey:
    """A stereo survey with the noise of ``seed``; ``shift_px`` moves all points of camera "left" to the right."""
    survey, truth = stereo(seed=1, n_pairs=n_pairs)
    survey = resample(survey, truth, seed)
    shift = np.array([shift_px, 0.0])
    blocks = tuple(
        replace(b, uv=b.uv + shift) if b.camera_id == "left" else b for b in survey.image_blocks
    )
    return replace(survey, image_blocks=blocks)


def write_epochs(place: Path, n: int, *, broken: bool = True, drift_px: float = 0.0) -> list[Path]:
    """``n`` project folders; where ``broken``, the third has a bad number and the fifth has images of nothing held."""
    folders = [place / f"night-{i + 1:02d}" for i in range(n)]
    for i, folder in enumerate(folders):
        write_project(folder, epoch_survey(100 + i, shift_px=drift_px * i), title=f"Night {i + 1}")
    if broken:
        table = folders[2] / "observations" / "image_points.csv"
        lines = table.read_text().splitlines(keepends=True)
        cells = lines[7].split(",")
        cells[4] = "6x1.2"
        table.write_text("".join([*lines[:7], ",".join(cells), *lines[8:]]))
        shutil.rmtree(folders[4] / "observations")
    return folders
