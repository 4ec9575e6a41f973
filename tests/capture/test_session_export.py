"""NeXus export: what stands in the file is what was recorded, read back with h5py."""

import cv2
import h5py
import numpy as np
import pytest

from adjust.model.errors import SurveyError
from capture.cli import main
from capture.plan.plan import read_plan
from capture.session.journal import read_journal
from capture.session.nexus import export
from capture.session.run import run_plan
from tests.capture.session_runs import write_plan


@pytest.mark.slow
def test_export_holds_the_run(tmp_path, capsys):
    plan = write_plan(tmp_path, options="repeats = 2")
    run_plan(read_plan(plan), shown=False)
    lab, file = tmp_path / "lab", tmp_path / "lab.nxs"
    assert main(["export", str(lab), str(file)]) == 0
    assert capsys.readouterr().out == f"{file}: 12 epochs, 24 images\n"
    sets = [r for r in read_journal(lab / "capture" / "journal.jsonl")[0] if r["kind"] == "set"]
    with h5py.File(file) as root:
        entry = root["entry"]
        assert entry.attrs["NX_class"] == "NXentry"
        assert [name.decode() for name in entry["epoch_id"]] == [r["epoch_id"] for r in sets]
        for i, name in enumerate(("axis1", "axis2")):
            axis = entry[f"instrument/turntable_{name}"]
            assert axis.attrs["NX_class"] == "NXpositioner"
            assert axis["value"].attrs["units"] == "deg"
            assert np.array_equal(axis["target_value"], [r["planned_deg"][i] for r in sets])
            assert np.array_equal(axis["value_after"], [r["after"]["readback_deg"][i] for r in sets])
        for camera in ("X", "Y"):
            detector = entry[f"instrument/{camera}"]
            assert detector.attrs["NX_class"] == "NXdetector"
            assert np.allclose(detector["count_time"], 500e-6)
            for k, record in enumerate(sets):
                image = cv2.imread(str(lab / "images" / camera / f"{record['epoch_id']}.png"), cv2.IMREAD_UNCHANGED)
                assert np.array_equal(detector["data"][k], image)
        assert root[root.attrs["default"]].attrs["default"] == "data"
        assert np.array_equal(entry["data/data"][0], entry["instrument/X/data"][0])


def test_export_refuses_what_is_not_whole(tmp_path):
    with pytest.raises(SurveyError, match="nothing is recorded"):
        export(tmp_path, tmp_path / "a.nxs")
    plan = write_plan(tmp_path)
    run_plan(read_plan(plan), shown=False)
    (tmp_path / "lab" / "images" / "X" / "t02.png").unlink()
    with pytest.raises(SurveyError, match=r"t02: X: .*t02\.png is missing"):
        export(tmp_path / "lab", tmp_path / "a.nxs")
    assert not list(tmp_path.glob("*.nxs*"))
