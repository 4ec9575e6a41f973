"""One competitor in a process of its own: ``python -m tests.benchmarks.worker KIND NAME CASE WARM OUT``.

Warms up on the case WARM, then answers every line on stdin with one run, as a line of JSON; the solution goes to OUT.
"""

import json
import os
import sys
from pathlib import Path
from time import perf_counter, process_time

import cv2
import numpy as np

from tests.benchmarks.kinds import make


def memory_mb(what: str) -> float:
    """``VmRSS`` or ``VmHWM`` (largest so far); the kernel's resource usage would inherit the parent's peak."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(what):
            return int(line.split()[1]) / 1024
    return float("nan")


def main() -> None:
    """Serve until stdin ends."""
    kind, name, case, warm, out = sys.argv[1:]
    cv2.setNumThreads(int(os.environ["LABSURVEY_THREADS"]))
    answers, sys.stdout = sys.stdout, sys.stderr  # what a library prints must not disturb the answers
    if warm != "-":
        make(kind, name, Path(warm))()
    run = make(kind, name, Path(case))
    idle = memory_mb("VmRSS")
    print(json.dumps({"ready": True}), file=answers, flush=True)
    for _ in sys.stdin:
        wall, cpu = perf_counter(), process_time()
        outcome = run()
        wall, cpu = perf_counter() - wall, process_time() - cpu
        np.savez(out, allow_pickle=False, **outcome.solution)
        answer = {"stages": outcome.stages, "wall": wall, "cpu": cpu, "note": outcome.note, "idle_mb": idle,
                  "peak_mb": memory_mb("VmHWM"), "numbers": outcome.numbers}  # fmt: skip
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
