"""How many planted gross errors the search finds, and how many good observations it leaves out.

``python -m tests.acceptance.gross_error_rates FIRST LAST``: one hall per seed, 5 % of its observations off by 6 to 50
sigma. An error counts where it is above 1.5 times the detectable bias that its observation has with all other planted
errors out. Nominal: what fails its test with exactly the planted errors out, which no search could keep.
"""

import sys
from dataclasses import replace

import numpy as np

from adjust.adjustment import adjust
from adjust.statistics.outliers.outcome import SearchOptions
from adjust.statistics.outliers.search import search_outliers
from adjust.statistics.reliability import observation_name, reliability
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2
from tests.adjust import statistics_networks as net
from tests.adjust.test_outlier_search import planted

FAMILY = 0.05


def one(seed):
    """Of one hall: errors that count, those missed, those missed and not named, false alarms, nominal ones."""
    clean, wrong, sizes = planted(seed)
    _, start = net.hall(seed, n_points=20, n_stations=4, n_tapes=20)
    readings = tuple(replace(r, used=r.reading_id not in sizes) for r in wrong.readings)
    right = adjust(replace(wrong, readings=readings), start)
    tests = reliability(right, most_influences=0).tests
    first, true = len(tests.used) - len(readings), {r.reading_id: r.value for r in clean.readings}
    counts = set()
    for i, r in enumerate(wrong.readings):
        if r.reading_id in sizes:
            least = tests.detectable_component[tests.ptr[first + i]]
            if 0.0 < 1.5 * least < abs(r.value - true[r.reading_id]):
                counts.add(r.reading_id)
    limit = chi2.isf(sidak(FAMILY, len(tests.used)), 1)
    fails = np.flatnonzero(tests.used & (tests.statistic > limit))
    nominal = {observation_name(right, int(i))[1][0] for i in fails}
    found = search_outliers(wrong, start, SearchOptions(FAMILY))
    out = {d.ids[0] for d in found.rejected}
    named = {key[1] for a in found.alternatives for key in (*a.kept, *a.instead)}
    return counts, counts - out, counts - out - named, out - set(sizes), nominal


def main():
    runs = [one(seed) for seed in range(int(sys.argv[1]), int(sys.argv[2]))]
    n = [sum(len(run[k]) for run in runs) for k in range(5)]
    print(
        f"{len(runs)} surveys: {n[0]} errors, {n[1]} missed ({n[2]} not named as an alternative); {n[3]} false "
        f"alarms in {sum(bool(run[3]) for run in runs)} surveys, {n[4]} in {sum(bool(run[4]) for run in runs)} nominal"
    )


if __name__ == "__main__":
    main()
