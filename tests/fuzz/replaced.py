"""A project in the middle of being replaced, with something beside it that is none of its business."""

import shutil
from pathlib import Path


def unfinished_project(folder: Path, entries: bytes) -> Path:
    """``folder/lab`` as a killed ``add`` leaves it, its list of entries as given; ``folder/victim`` beside it."""
    shutil.rmtree(folder / "lab", ignore_errors=True)
    for name in ("victim", "lab/.before/observations", "lab/.adding", "lab/observations", "lab/results"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    (folder / "victim" / "thesis.txt").write_text("the only copy")
    (folder / "lab" / "survey.toml").write_text("new")
    (folder / "lab" / "observations" / "pairs.csv").write_text("new")
    (folder / "lab" / ".before" / "survey.toml").write_text("old")
    (folder / "lab" / ".before" / "observations" / "pairs.csv").write_text("old")
    (folder / "lab" / ".before" / "entries.json").write_bytes(entries)
    return folder / "lab"
