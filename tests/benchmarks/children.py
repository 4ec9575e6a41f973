"""Competitors in processes of their own, run in turn, so that a busy moment of the machine meets all of them."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from adjust.model.survey import FloatArray
from tests.benchmarks.kinds import Case, kind_of

SYSTEM_PYTHON = "/usr/bin/python3"
MRCAL = "mrcal optimize"


@dataclass(eq=False)
class Measured:
    """Seconds of all runs: the sum of the stages (``seconds``), each stage, processor time; memory; the solution.

    idle_mb: the process with the data loaded, after a small case. peak_mb: its largest size in all runs.
    """

    case: str
    name: str
    seconds: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    stages: dict[str, list[float]] = field(default_factory=dict)
    idle_mb: float = float("nan")
    peak_mb: float = float("nan")
    note: str = ""
    numbers: dict[str, float] = field(default_factory=dict)
    solution: dict[str, FloatArray] = field(default_factory=dict)
    failed: str = ""

    @property
    def median(self) -> float:
        return float(np.median(self.seconds)) if self.seconds else float("nan")

    def take(self, answer: dict[str, Any]) -> None:
        """Add one run."""
        self.seconds.append(sum(answer["stages"].values()))
        self.cpu.append(answer["numbers"].pop("child_cpu", answer["cpu"]))
        for stage, seconds in answer["stages"].items():
            self.stages.setdefault(stage, []).append(seconds)
        self.idle_mb, self.peak_mb, self.note = answer["idle_mb"], answer["peak_mb"], answer["note"]
        if "child_mb" in answer["numbers"]:
            self.idle_mb, self.peak_mb = 0.0, answer["numbers"].pop("child_mb")
        self.numbers = answer["numbers"]


def why_no_mrcal() -> str:
    """Why mrcal cannot take part; empty where it can."""
    if not Path(SYSTEM_PYTHON).exists():
        return f"there is no {SYSTEM_PYTHON}"
    found = subprocess.run([SYSTEM_PYTHON, "-c", "import mrcal"], capture_output=True, text=True, check=False)
    return "" if found.returncode == 0 else f"{SYSTEM_PYTHON} cannot import mrcal (Debian package: mrcal)"


class Child:
    """A worker process, ready to run; that of another checkout in its folder ``root``."""

    def __init__(
        self, kind: str, name: str, case: Path, warm: Path, threads: int, root: Path | None = None
    ) -> None:  # fmt: skip
        self.out = case.with_name(f"{case.stem}.{abs(hash((name, root)))}.out.npz")
        self.errors = tempfile.TemporaryFile(mode="w+")  # noqa: SIM115  # lives as long as the process
        command = [sys.executable, "-m", "tests.benchmarks.worker", kind, name, str(case), str(warm), str(self.out)]
        if name == MRCAL:
            script = Path(__file__).with_name("mrcal_worker.py")
            command = [SYSTEM_PYTHON, str(script), str(case), str(warm), str(self.out)]
        one = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": str(threads), "LABSURVEY_THREADS": str(threads)}
        if root is not None:
            one["PYTHONPATH"] = str(root)
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.errors,
                                        text=True, env=os.environ | one, cwd=root)  # fmt: skip

    def answer(self) -> dict[str, Any] | str:
        """The next line of the worker, or the last line of its errors where it has ended."""
        line = self.process.stdout.readline() if self.process.stdout else ""
        if line:
            found: dict[str, Any] = json.loads(line)
            return found
        self.process.wait()
        self.errors.seek(0)
        lines = self.errors.read().strip().splitlines()
        return lines[-1] if lines else f"ended with {self.process.returncode}"

    def run(self) -> dict[str, Any] | str:
        """One run."""
        if self.process.stdin is None:
            return "no input"
        try:
            self.process.stdin.write("run\n")
            self.process.stdin.flush()
        except BrokenPipeError:
            pass
        return self.answer()

    def end(self) -> dict[str, FloatArray]:
        """Stop the process; the last solution."""
        if self.process.stdin is not None:
            self.process.stdin.close()
        self.process.wait()
        self.errors.close()
        if not self.out.exists():
            return {}
        with np.load(self.out) as data:
            return {name: data[name] for name in data.files}


def compete(
    label: str, case: Case, warm: Case | None, names: Sequence[str], rounds: int = 5,
    threads: int = 1, budget: float = 60.0,
) -> list[Measured]:  # fmt: skip
    """All competitors on one case, in turn; one that has used its ``budget`` (s) drops out of the later rounds.

    A competitor that works alone on a case of its own needs no ``warm`` one.
    """
    found = [Measured(label, name) for name in names]
    with tempfile.TemporaryDirectory() as folder:
        paths = Path(folder) / "case.npz", Path(folder) / "warm.npz"
        case.save(paths[0])
        if warm is None:
            paths = paths[0], Path("-")
        else:
            warm.save(paths[1])
        children = []
        for m in found:
            m.failed = why_no_mrcal() if m.name == MRCAL else ""
            children.append(None if m.failed else Child(kind_of(case), m.name, *paths, threads))
        for m, child in zip(found, children, strict=True):  # they warm up side by side, which is not measured
            if child is not None:
                answer = child.answer()
                m.failed = answer if isinstance(answer, str) else ""
        for _ in range(rounds):
            for m, child in zip(found, children, strict=True):
                if child is None or m.failed or sum(m.seconds) > budget:
                    continue
                answer = child.run()
                if isinstance(answer, str):
                    m.failed = answer
                else:
                    m.take(answer)
        for m, child in zip(found, children, strict=True):
            if child is not None:
                m.solution = child.end()
            if m.failed:
                print(f"  {label}: {m.name} left out: {m.failed}", file=sys.stderr)
    return found
