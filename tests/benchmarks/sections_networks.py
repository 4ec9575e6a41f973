"""Networks of poses and of readings, and simulations by the thousand."""

import numpy as np

from tests.benchmarks import growth, pose_graphs, tables, terrestrial, trials
from tests.benchmarks.children import Measured
from tests.benchmarks.plots import Line
from tests.benchmarks.session import Session
from tests.data import data_folder


def published_graphs(session: Session) -> None:
    """Sphere, torus, garage."""
    session.say("", "## Pose graphs", "")
    session.say(
        "From the same start (the one that ours finds; not counted), to the same optimum. Ours: covariances of all "
        "poses, redundancy numbers and tests of all pairs. GTSAM: its native factors and optimisers, and "
        "`marginalCovariance` of every pose; its first pose has a prior of 0.1 mm, ours is held. GTSAM's marginals of "
        "the torus take so long that they are run once."
    )
    folder = data_folder("calibration", "pose_graphs")
    names = ("parking-garage",) if session.quick else ("parking-garage", "sphere2500", "torus3D")
    warm, rows = pose_graphs.read(folder / "tinyGrid3D.g2o"), []
    ours, gauss = pose_graphs.OURS, pose_graphs.GAUSS_NEWTON
    for name in names:
        case = pose_graphs.read(folder / f"{name}.g2o")
        found = session.compete(name, case, warm, list(pose_graphs.GRAPHS), budget=8.0)
        what = f"{name} with covariances: times as long takes GTSAM"
        starts = "both: the start that ours finds, not counted"
        session.claim(what, tables.times_as_long(found[gauss], found[ours]), 1.0, "", True, starts)
        alone = {n: _solution(found[n]) / _solution(found[ours]) for n in (gauss, pose_graphs.LEVENBERG)}
        what = f"{name}, graph and solution alone: times as long takes GTSAM's"
        session.claim(f"{what} Gauss-Newton", alone[gauss], 1.0, "", True, starts)
        session.compare(f"{what} Levenberg-Marquardt", alone[pose_graphs.LEVENBERG], starts)
        session.say("", f"### {name}: {len(case.start)} poses, {len(case.a)} pairs", "")
        session.say(tables.times(list(found.values()), found[ours]), "", tables.stages(list(found.values())), "")
        apart = {n: pose_graphs.difference(case, found[ours].solution, found[n].solution)
                 for n in found if n != ours and found[n].seconds}  # fmt: skip
        rows += [[name, n, f"{found[n].numbers['omega']:.8f}", f"{d:.1e}"] for n, d in {ours: 0.0, **apart}.items()]
        if found[gauss].seconds:
            mine, other = found[ours].solution["cov"][1:], found[gauss].solution["cov"][1:]
            relative = np.abs(np.sqrt(np.diagonal(other, axis1=1, axis2=2) / np.diagonal(mine, axis1=1, axis2=2)) - 1)
            session.say(f"Standard deviations agree to {relative.max():.1e}.")
    session.say("", tables.table(("", "", "v'Pv", "largest difference, sigmas"), rows))


def _solution(m: Measured) -> float:
    """Median seconds of the graph and its solution, without covariances and tests; nan where it did not run."""
    return sum(float(np.median(m.stages[s])) for s in ("build", "solve") if s in m.stages) or float("nan")


def additions(session: Session) -> None:
    """Stations added one at a time."""
    rows = 400 if session.quick else 5000
    session.say("", f"## {2 * rows} additions", "")
    case, warm = growth.Stations(np.array(rows), np.array(2)), growth.Stations(np.array(20), np.array(2))
    runs = [session.compete("additions", case, warm, [growth.GROWN], rounds=1)[growth.GROWN]
            for _ in range(1 if session.quick else 5)]  # fmt: skip
    for m in runs:
        if m.failed:
            session.say(f"Failed: {m.failed}.")
            return
    m, ms = runs[0], np.median([run.solution["ms"] for run in runs], axis=0)
    step = max(1, len(ms) // 10)
    parts = [ms[i : i + step] for i in range(0, step * 10, step)]
    table = [
        [str(i * step), f"{np.median(p):.2f}", f"{np.quantile(p, 0.95):.2f}", f"{p.max():.1f}"]
        for i, p in enumerate(parts)
    ]
    what = "A corridor, two stations a row, every one with its pairs to those before"
    session.say(f"{what}, as `labsurvey add --live` takes them.", "")
    session.say(f"Milliseconds of processor time an addition, of each the median of {len(runs)} runs:", "")
    session.say(tables.table(("stations before", "median", "95 %", "worst"), table), "")
    longer = np.median(parts[-1]) / np.median(parts[1])
    session.say(
        f"The last tenth takes {longer:.2f} times as long as the second. Difference to the batch solution: "
        f"{m.numbers['before_sigma']:.1e} sigmas while it grows, {m.numbers['after_sigma']:.1e} after finishing "
        f"({m.stages['finish'][0]:.2f} s; from nothing {m.numbers['batch_s']:.2f} s); {m.peak_mb:.0f} MB."
    )
    sizes = np.arange(1, 10) * float(step)
    shown = [Line("median", sizes, np.array([np.median(p) for p in parts[1:]]), True),
             Line("95 %", sizes, np.array([np.quantile(p, 0.95) for p in parts[1:]]))]  # fmt: skip
    session.claim(f"{2 * rows} additions: exponent of time by stations before", shown[0].exponent, 0.15)
    session.picture("additions", shown, "One more station", "stations before", "ms")
    _command(session, case, warm)


def _command(session: Session, case: growth.Stations, warm: growth.Stations) -> None:
    """What the command for additions takes, which reads and writes a project and tells all covariances and tests."""
    m = session.compete("labsurvey add", case, warm, [growth.ADDED], budget=8.0, rounds=1)[growth.ADDED]
    if m.failed:
        session.say("", f"`labsurvey add` failed: {m.failed}.")
        return
    parts = [[name, f"{np.median(s):.2f}"] for name, s in m.stages.items()]
    session.say(
        "",
        f"`labsurvey add` with the last {growth.LATE} of these stations, begun {m.note}: it solves all pairs again, "
        "for it tells the covariances and tests of all. Seconds:", "", tables.table(("", "s"), parts), "",
        f"Processor time {m.cpu[0]:.1f} s, {m.peak_mb:.0f} MB.",
    )  # fmt: skip


def large_networks(session: Session) -> None:
    """From nothing to all variances."""
    session.say("", "## Large pose networks from nothing", "")
    session.say("Start values, least squares, then all variances, redundancy numbers and tests; full covariances.", "")
    sizes = ((100, 4),) if session.quick else ((250, 10), (1000, 10), *(((10000, 10),) if session.long else ()))
    warm, rows, found = growth.Stations(np.array(10), np.array(4)), [], []
    for nx, ny in sizes:
        case = growth.Stations(np.array(nx), np.array(ny))
        m = session.compete(f"{nx} x {ny}", case, warm, [growth.BATCH], budget=8.0, rounds=3)[growth.BATCH]
        found.append(m)
        if not m.failed:
            n = m.numbers
            each = [tables.seconds(float(np.median(s))) for s in m.stages.values()]
            rows.append([str(nx * ny), f"{n['pairs']:.0f}", *each, m.note, f"{n['omega']:.1f}",
                         f"{n['redundancy']:.0f}", f"{n['redundancy_sum'] - n['redundancy']:+.1e}",
                         f"{m.peak_mb:.0f}"])  # fmt: skip
    head = ("stations", "pairs", "start, solve", "precision", "", "v'Pv", "redundancy", "sum of numbers less it", "MB")
    session.say(tables.table(head, rows))
    sizes_ = np.array([float(nx * ny) for nx, ny in sizes])
    every = [Line("sum", sizes_, np.array([m.median for m in found]), True)]
    session.picture("pose-networks", every, "Pose networks from nothing", "stations")


def readings(session: Session) -> None:
    """Total stations."""
    session.say("", "## Networks of total station readings", "")
    session.say(
        "Directions, zenith angles, slope distances; a quarter of the points set up; 3 cm off at the start. "
        "Ours: variances, redundancy numbers and tests of everything, and the whole covariance matrix up to "
        f"{terrestrial.FULL_UP_TO} unknowns. Dense NumPy: normal equations as one matrix, LAPACK's Cholesky and "
        "inverse; its rows are made in Python, so its own share is “solve” and “precision”. “free”: inner constraints "
        "over all points. GNU Gama takes part [from file to file](#beside-gnu-gama)."
    )
    ours, dense = terrestrial.OURS, terrestrial.DENSE
    runs = [(100, False), (100, True)] if session.quick else [(300, False), (1000, False), (1000, True), (3000, False),
                                                              (10000, False)]  # fmt: skip
    warm, rows, sums = terrestrial.case(50), [], []
    for n, free in runs:
        names = [ours, dense] if n <= 1000 else [ours]
        label = f"{n}{' free' if free else ''}"
        found = session.compete(label, terrestrial.case(n, free), warm, names, budget=12.0)
        if not free:
            sums.append((n, found))
        _reading_claims(session, n, free, found[ours])
        for m in found.values():
            rows.append([label, m.name, tables.seconds(m.median), *_parts(m.stages), m.note, f"{m.peak_mb:.0f}"])
        if dense in found and found[dense].seconds:
            session.say("", f"{label}: {_agreement(found[ours], found[dense], free)}")
    session.say("", tables.table(("points", "", "s (median)", *_NAMES, "", "peak MB"), rows))
    sizes = np.array([float(n) for n, _ in sums])
    times = [Line(k, sizes, np.array([f[k].median if k in f else np.nan for _, f in sums]), k == ours)
             for k in (ours, dense)]  # fmt: skip
    session.picture("readings", times, "Networks of readings", "points")
    memory = [Line(ours, sizes, np.array([f[ours].peak_mb for _, f in sums]), True)]
    session.picture("readings-memory", memory, "Networks of readings, memory", "points", "MB")


def _reading_claims(session: Session, n: int, free: bool, m: Measured) -> None:
    what = f"{n} points{', free' if free else ''}"
    if n == 1000:
        session.claim(f"{what}: every statistic and the whole covariance", m.median, 3.0, "s")
    if n == 3000:
        session.claim(f"{what}: memory", m.peak_mb, 2400.0, "MB")
    if n == 10000:
        session.claim(f"{what}: solution and variances", m.median, 60.0, "s")


def _agreement(ours: Measured, dense: Measured, free: bool) -> str:
    known = dense.solution["sigmas"] > 0
    x, s = ([m.solution[name][known] for m in (ours, dense)] for name in ("x", "sigmas"))
    apart, wider = (np.abs(x[0] - x[1]) / s[1]).max(), np.abs(s[0] / s[1] - 1.0).max()
    more = ours.numbers["omega"] / dense.numbers["omega"] - 1.0
    # where a free network lies is that of its start, to which the two refer in other ways
    first = "" if free else f"coordinates differ by {apart:.1e} sigmas, "
    return f"{first}sigmas differ by {wider:.1e} of them, v'Pv by {more:.1e} of it."


_NAMES = ("build", "rows in Python", "solve", "tree", "statistics", "precision", "full covariance")


def _parts(stages: dict[str, list[float]]) -> list[str]:
    return [tables.seconds(float(np.median(stages[name]))) if name in stages else "" for name in _NAMES]


def simulations(session: Session) -> None:
    """Monte Carlo."""
    session.say("", "## Simulations by the thousand", "")
    trial, points = (1000, 1000) if session.quick else (1000, 10_000)
    found = session.compete(
        "table 1", trials.Trials(np.array(trial)), trials.Trials(np.array(10)), [trials.TABLE_1, trials.TABLE_1_GTSAM]
    )
    session.claim(f"Table 1, {trial} trials", found[trials.TABLE_1].median, 2.0, "s")
    session.say(f"Table 1 of the relay paper, four cameras, {trial} trials:", "")
    session.say(tables.times(list(found.values()), found[trials.TABLE_1]), "")
    found = session.compete("curves", trials.Trials(np.array(points)), trials.Trials(np.array(10)), [trials.ERRORS])
    session.claim(f"Error analysis, {points} trials a point", found[trials.ERRORS].median, 10.0, "s")
    session.say(f"Error analysis of the head's paper, {points} trials a point:", "")
    session.say(tables.times(list(found.values()), found[trials.ERRORS]))
