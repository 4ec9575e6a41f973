"""Workbenches with a solution: projects whose files say the same are adjusted once for all tests of a process."""

import hashlib
from pathlib import Path

from survey.workbench.session import Workbench
from survey.workbench.situation import Situation

_adjusted: dict[str, Situation] = {}


def adjusted_bench(folder: Path, read_only: bool = False) -> Workbench:
    """As of a project that was read and adjusted."""
    bench = Workbench(folder, read_only=read_only)
    read = [folder / "survey.toml", *sorted((folder / "observations").glob("*"))]
    files = "".join(f"{p.name} {hashlib.sha256(p.read_bytes()).hexdigest()}\n" for p in read)
    known = _adjusted.get(files)
    if known is None:
        bench.adjust()
        _adjusted[files] = bench.situation
    else:
        bench.take(bench.situation.solved_as(known))
    return bench
