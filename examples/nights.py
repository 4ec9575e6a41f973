"""Twelve nights of the same rig as a batch: one camera slips in the eighth night, and the control charts say which.

Run: python examples/nights.py
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import survey
from survey.simulate import resample, stereo

SLIP_PX = 25.0


def main() -> None:
    with tempfile.TemporaryDirectory() as place:
        folders = write_nights(Path(place))
        batch = survey.adjust_many(folders, report=Path(place) / "overview")
        print(batch)
        for name, chart in batch.charts.iterrows():
            if not chart["in_control"]:
                print(f"{name}: {chart['findings']}")


def write_nights(place: Path) -> list[Path]:
    """From the eighth night on the lens of the left camera sits a little lower: its principal point moves."""
    rig, truth = stereo(seed=1, n_pairs=5)
    folders = [place / f"night-{k + 1:02d}" for k in range(12)]
    for k, folder in enumerate(folders):
        night = resample(rig, truth, seed=k)
        if k >= 7:
            blocks = [
                replace(b, uv=b.uv + np.array([0.0, SLIP_PX])) if b.camera_id == "left" else b
                for b in night.image_blocks
            ]
            night = replace(night, image_blocks=tuple(blocks))
        survey.write_project(folder, night, title=f"Night {k + 1}")
    return folders


if __name__ == "__main__":
    main()
