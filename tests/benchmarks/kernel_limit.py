"""How far the kernel of image points is from what the machine can do: arithmetic by a matrix product, memory by a copy.

``python -m tests.benchmarks.kernel_limit``
"""

import os
from concurrent.futures import ThreadPoolExecutor
from time import perf_counter

import numpy as np

from adjust.graph.building import GraphBuilder
from tests.benchmarks import tables
from tests.benchmarks.data import calibration, rough_start, survey

_OTHER_FLOPS = 285
"""Additions, multiplications and divisions of a point's lens, pose and weight, eight free coefficients of the lens."""
_BYTES = 10 * 8
"""Read of a point: target coordinates, image coordinates, root of its weight matrix, shape of the target."""


def _best(run: object, times: int = 7) -> float:
    """Seconds of the fastest of several runs."""
    found = []
    for _ in range(times):
        begin = perf_counter()
        run()
        found.append(perf_counter() - begin)
    return min(found)


def gram_flops(n: int) -> int:
    """Multiplications and additions of a point's two rows, n columns, taken three by three from the diagonal on."""
    return sum(min(3, n - j) * (n - j) * 2 * 2 for j in range(0, n, 3))


def kernel_against_machine() -> str:
    """A table: nanoseconds an image point takes, and at least takes here by arithmetic and by memory alone."""
    case = calibration(3, 200)
    start = rough_start(case)
    graph = GraphBuilder(survey(case), start.lenses).build(start)
    images, values = graph.images, graph.start
    graph.prepare(values, True)

    def kernel() -> None:
        images.prepare(True)

    a, big = np.random.default_rng(1).normal(size=(512, 512)), np.zeros(20_000_000)
    into = np.empty_like(big)
    points = images.n_points
    rate = 2 * 512**3 / _best(lambda: a @ a)
    bandwidth = 2 * big.nbytes / _best(lambda: np.copyto(into, big))
    halves = list(zip(np.array_split(into, 2), np.array_split(big, 2), strict=True))
    with ThreadPoolExecutor(2) as pool:
        by_two = 2 * big.nbytes / _best(lambda: list(pool.map(lambda half: np.copyto(*half), halves)))
    n = int(images.n_rows[0])
    flops = gram_flops(n) + _OTHER_FLOPS
    measured = _best(kernel) / points
    reduced = 0.0 if graph.reduction is None else _best(lambda: graph.reduction.reduce(0.0)) / points
    rows = [
        ["normal equations", f"{1e9 * measured:.0f}", ""],
        ["poses reduced", f"{1e9 * reduced:.0f}", ""],
        [f"{flops} operations as fast as in a product of matrices", f"{1e9 * flops / rate:.0f}",
         f"{rate / 1e9:.0f} GFLOP/s"],
        [f"{_BYTES} bytes at the rate of a copy", f"{1e9 * _BYTES / bandwidth:.0f}", f"{bandwidth / 1e9:.0f} GB/s"],
        ["a copy by two threads", "", f"{by_two / 1e9:.0f} GB/s"],
    ]  # fmt: skip
    share = 100 * flops / rate / measured
    return tables.table(("3 x 200, 60,000 image points", "ns a point", ""), rows) + (
        f"\n\nThe kernel runs at {share:.0f} % of the rate of a product of matrices; memory is no limit."
    )


if __name__ == "__main__":
    print(f"LABSURVEY_THREADS={os.environ.get('LABSURVEY_THREADS', 'all cores')}")
    print(kernel_against_machine())
