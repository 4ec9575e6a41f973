"""Sigmas of Euler angles reach the tangent through the Jacobian of the angles."""

from pathlib import Path

import numpy as np
import pytest
from gtsam import Rot3

from adjust.model.errors import SurveyError
from survey import project as files

TOML = """format = 1
[stations.a]
motion = "fixed"
world_from_station = { treatment = "held" }
[stations.b]
motion = "fixed"
"""
HEAD = "pair_id,a_id,b_id,euler_x_deg,euler_y_deg,euler_z_deg," + ",".join(f"sigma_euler_{a}_arcsec" for a in "xyz")
ARCSEC = np.pi / 180 / 3600


def _project(folder: Path, row: str) -> Path:
    (folder / "observations").mkdir()
    (folder / "survey.toml").write_text(TOML)
    (folder / "observations" / "pairs.csv").write_text(f"{HEAD}\n{row}\n")
    return folder


def test_euler_sigmas_become_the_scatter_of_the_tangent(tmp_path: Path) -> None:
    angles, sigmas = np.radians([40.0, 50.0, -110.0]), np.array([300.0, 100.0, 200.0]) * ARCSEC
    (pair,) = files.read(_project(tmp_path, "p,station:a,station:b,40,50,-110,300,100,200")).survey.pairs
    turned = [Rot3.RzRyRx(*x) for x in np.random.default_rng(1).normal(angles, sigmas, (20000, 3))]
    mean = Rot3.RzRyRx(*angles)
    assert mean.equals(pair.b_from_a, 1e-12)
    scatter = np.cov(np.array([Rot3.Logmap(mean.between(R)) for R in turned]).T)
    assert np.abs(pair.cov - scatter).max() < 0.03 * pair.cov.max()
    assert not np.allclose(np.diag(pair.cov), sigmas**2, rtol=0.05)  # without the Jacobian it would be this


def test_gimbal_lock_is_an_error_with_its_line(tmp_path: Path) -> None:
    with pytest.raises(SurveyError, match=r"pairs\.csv:2.*sigma_euler.*gimbal"):
        files.read(_project(tmp_path, "p,station:a,station:b,0,90,0,300,100,200"))
