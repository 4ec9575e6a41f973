"""``python -m tests.acceptance.gama_folder FOLDER [WORK]``: every ``.gkf`` below a folder converted and adjusted.

Through the command line, as a user does it; where Gama's own result stands beside the file, coordinates and sigmas of
``results/solution.json`` are held against it. Nothing of the folder is changed.
"""

import contextlib
import io
import json
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from survey.cli import main
from survey.interop.networks.foreign import safe_ids
from tests.acceptance.gama_results import GamaResult, gama_result

SOLVED = (0, 3)
CLOSE_M = 1e-6


@dataclass(frozen=True)
class GamaRun:
    """What the two commands did with one file, and how far its numbers are from Gama's.

    state: "refused" (by convert), "failed" (in adjust), "adjusted". said: the last lines of what was printed.
    coordinate_m, sigma_ratio (least and largest), sigma0_ratio: None where Gama's result is missing.
    """

    name: str
    state: str
    said: str = ""
    coordinate_m: float | None = None
    sigma_ratio: tuple[float, float] | None = None
    sigma0_ratio: float | None = None
    redundancy: tuple[int, int] | None = None
    worst: str = ""
    notes: tuple[str, ...] = field(default_factory=tuple)

    @property
    def agrees(self) -> bool:
        """To 1e-6 m, and sigmas to a thousandth (Gama's own belong to its last linearisation)."""
        if self.coordinate_m is None or self.sigma_ratio is None:
            return False
        return self.coordinate_m <= CLOSE_M and max(abs(r - 1.0) for r in self.sigma_ratio) <= 1e-3


def run_command(*argv: str) -> tuple[int, str]:
    """Exit code of a command, and all that it printed."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = main(list(argv))
    return code, said.getvalue()


def convert_and_adjust(gkf: Path, project: Path) -> GamaRun:
    """One file through ``convert`` and ``adjust``, compared where NAME.xml is beside it."""
    name = gkf.stem
    code, said = run_command("convert", str(gkf), str(project))
    if code != 0:
        return GamaRun(name, "refused", said.strip())
    notes = tuple(line.removeprefix("  ! ") for line in said.splitlines() if line.startswith("  ! "))
    code, said = run_command("adjust", str(project), "--quiet")
    if code not in SOLVED:
        return GamaRun(name, "failed", said.strip(), notes=notes)
    published = gkf.with_suffix(".xml")
    if not published.is_file():
        return GamaRun(name, "adjusted", notes=notes)
    solution = json.loads((project / "results" / "solution.json").read_text(encoding="utf-8"))
    return compared(name, solution, gama_result(published), notes)


def compared(name: str, solution: dict, published: GamaResult, notes: tuple[str, ...] = ()) -> GamaRun:
    """``solution.json`` beside Gama's XML; sigmas as both print them."""
    renamed = safe_ids(list(dict.fromkeys(p for p, _ in published.adjusted)), {"world"})
    points, summary = solution["points"], solution["summary"]
    sigma = np.sqrt(np.diagonal(published.cov))[: len(published.adjusted)]
    off, ratio, worst = [], [], []
    for (point, axis), x, s in zip(published.adjusted, published.adjusted.values(), sigma, strict=True):
        entry = points.get(renamed.get(point, point))
        if entry is None:
            return GamaRun(name, "adjusted", f"point {point!r} is in Gama's result alone", notes=notes)
        off.append(abs(1e-3 * entry[f"{axis}_mm"] - x))
        ratio.append(1e-3 * entry[f"sigma_{axis}_mm"] / s if s > 0.0 else 1.0)
        worst.append(f"{axis} of {point}")
    known = summary["sigma0"] is not None and published.aposteriori > 0.0
    sigma0 = summary["sigma0"] * published.apriori / published.aposteriori if known else None
    return GamaRun(
        name, "adjusted", "", max(off), (min(ratio), max(ratio)), sigma0,
        (summary["redundancy"], published.redundancy), worst[int(np.argmax(off))], notes,
    )  # fmt: skip


def folder_runs(folder: Path, work: Path) -> list[GamaRun]:
    """All files below ``folder``, in the order of their names."""
    return [convert_and_adjust(gkf, work / f"{i:03d}") for i, gkf in enumerate(sorted(folder.rglob("*.gkf")))]


def row(run: GamaRun) -> str:
    """One line for people."""
    if run.coordinate_m is None or run.sigma_ratio is None:
        return f"{run.name:38} {run.state:9} {' | '.join(run.said.splitlines()[-3:])[:260]}"
    counts = "" if run.redundancy is None or len(set(run.redundancy)) == 1 else f" r {run.redundancy}"
    sigma0 = "-" if run.sigma0_ratio is None else f"{run.sigma0_ratio:.7f}"
    low, high = run.sigma_ratio
    verdict = "ok" if run.agrees else f"OFF {run.worst}"
    numbers = f"{run.coordinate_m:9.2g} m  sigmas {low:.6f}..{high:.6f}  s0 {sigma0}{counts}"
    return f"{run.name:38} {run.state:9} {numbers}  {verdict}"


def _main() -> None:
    folder = Path(sys.argv[1])
    with tempfile.TemporaryDirectory() as scratch:
        runs = []
        for i, gkf in enumerate(sorted(folder.rglob("*.gkf"))):
            runs.append(convert_and_adjust(gkf, Path(sys.argv[2] if len(sys.argv) > 2 else scratch) / f"{i:03d}"))
            print(row(runs[-1]), *(f"\n      ! {note}" for note in runs[-1].notes), flush=True)
    done = [r for r in runs if r.state == "adjusted"]
    with_result = [r for r in done if r.coordinate_m is not None]
    print(f"{len(runs)} files: {sum(r.state != 'refused' for r in runs)} converted, {len(done)} adjusted, "
          f"{len(with_result)} beside Gama's result, {sum(r.agrees for r in with_result)} agree")  # fmt: skip


if __name__ == "__main__":
    _main()
