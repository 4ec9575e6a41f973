"""GNU Gama's files through ``convert`` and ``adjust``, coordinates and sigmas beside Gama's own results."""

import pytest

from tests.acceptance.gama_folder import convert_and_adjust
from tests.acceptance.networks import DEFAULTS
from tests.data import data_folder


@pytest.mark.usefixtures("undiagnosed")
@pytest.mark.parametrize("name", [*DEFAULTS, "2019-08-20-knin_test", "tst-tetrahedron-1"])
def test_coordinates_sigmas_and_sigma0_are_gamas(tmp_path, name):
    """To 1e-6 m; sigmas and sigma0 to what Gama's last linearisation leaves (1e-4)."""
    run = convert_and_adjust(data_folder("network", "gama_defaults") / f"{name}.gkf", tmp_path / "net")
    assert run.state == "adjusted", run.said
    assert run.coordinate_m <= 1e-6
    assert run.sigma_ratio == pytest.approx((1.0, 1.0), abs=1e-4)
    assert run.sigma0_ratio == pytest.approx(1.0, abs=1e-4)
    assert run.redundancy[0] == run.redundancy[1]


def test_what_tol_abs_takes_out_is_said(tmp_path):
    run = convert_and_adjust(data_folder("network", "gama_defaults") / "tst-tetrahedron-1.gkf", tmp_path / "net")
    assert "dh2 (height difference 1 - 2) by 1500.025 m" in run.notes[0]
    table = (tmp_path / "net" / "observations" / "terrestrial.csv").read_text(encoding="utf-8")
    assert [line.split(",")[3] for line in table.splitlines() if line.endswith(",false")] == ["dh2"]
