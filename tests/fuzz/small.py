"""The smallest project with results: three tripods and all their relative poses."""

import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path


def small_project(folder: Path) -> None:
    """Three tripods and all their relative poses; adjusts in milliseconds."""
    rows = ["pair_id,a_id,b_id,qw,qx,qy,qz,tx_mm,ty_mm,tz_mm,sigma_rotation_arcsec,sigma_translation_mm"]
    rows += ["p1,a,b,1,0,0,0,-1000,0,0,10,0.1", "p2,b,c,1,0,0,0,0,-1000.05,0,10,0.1"]
    rows += ["p3,a,c,1,0,0,0,-1000,-1000,0.05,10,0.1"]
    (folder / "observations").mkdir(parents=True)
    (folder / "observations" / "pairs.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    text = 'format = 1\n[stations.a]\nworld_from_station = { treatment = "held" }\n[stations.b]\n[stations.c]\n'
    (folder / "survey.toml").write_text(text, encoding="utf-8")


@cache
def adjusted() -> dict[str, bytes]:
    """Its files by name once it was adjusted, results/solution.json and results/covariance.npz among them."""
    from survey.jobs.adjusting.job import adjust_job

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "small"
        small_project(folder)
        adjust_job(folder, progress=False)
        names = ("survey.toml", "observations/pairs.csv", "results/solution.json", "results/covariance.npz",
                 "runs/0001/run.json", "runs/0001/estimates.npz", "runs/0001/survey.toml")  # fmt: skip
        return {name: (folder / name).read_bytes() for name in names}


def put(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files by their names below a folder."""
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
