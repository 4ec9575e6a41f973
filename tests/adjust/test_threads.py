"""Whole adjustments are the same to the last bit for any number of threads."""

import os
import signal
import threading
import time
import warnings
from collections.abc import Callable

import numpy as np
import pytest
from gtsam import Pose3

from adjust.adjustment import adjust
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray
from adjust.native.parallel import Beside, side_by_side
from adjust.pose_network.network import survey_of as survey_of_pairs
from adjust.statistics.screened_adjustment import adjust_cleaned
from tests.adjust import pose_networks
from tests.benchmarks import bundle
from tests.benchmarks.building import Plan, build
from tests.benchmarks.data import calibration
from tests.benchmarks.data import survey as calibration_survey
from tests.benchmarks.dissection import survey_of


def boards() -> Adjustment:
    """12,000 image points: the epochs are reduced in several sums."""
    return adjust(calibration_survey(calibration(2, 60)))


def building() -> Adjustment:
    """Two rooms of 100 stations: two of Helmert's blocks."""
    rooms = build(Plan(2, 1))
    return adjust(survey_of(rooms), bundle.start(rooms.bundle))


def pairs() -> Adjustment:
    """A network of 1,000 stations with five wrong pairs, which are looked for."""
    return adjust_cleaned(survey_of_pairs(pose_networks.simulate(20, 50, 1, wrong=5).network))


def numbers(found: Adjustment) -> list[FloatArray]:
    values = [e.value.matrix() if isinstance(e.value, Pose3) else np.asarray(e.value) for e in found.estimates.values()]
    covariances = [np.asarray(e.cov) for e in found.estimates.values()]
    points = found.image_residuals
    return [*values, *covariances, points.residuals, points.redundancy, points.test, np.array([found.omega])]


@pytest.mark.slow
@pytest.mark.parametrize("make", [boards, building, pairs])
def test_the_same_bits_for_any_number_of_threads(
    make: Callable[[], Adjustment], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = []
    for threads in "123":
        monkeypatch.setenv("LABSURVEY_THREADS", threads)
        found.append(numbers(make()))
    for other in found[1:]:
        assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(found[0], other, strict=True))


@pytest.mark.parametrize("threads", ["1", "3"])
def test_steps_beside_each_other(threads: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each gives its result or raises; all are done when it is left; a step shares out work, parts of it do not."""
    monkeypatch.setenv("LABSURVEY_THREADS", threads)
    names, done, gate, two = set[str](), list[int](), threading.Event(), threading.Barrier(2)

    def part(i: int) -> int:
        names.add(threading.current_thread().name)
        if threads == "3" and i < 2:
            two.wait(5.0)  # each by another thread
        return sum(side_by_side(lambda j: i * j, range(4)))

    def failing() -> int:
        raise ValueError("step")

    def late() -> None:
        gate.wait(5.0)
        done.append(1)

    def everything() -> None:
        with Beside() as steps:
            first = steps.of(lambda: side_by_side(part, range(20)))
            assert first() == first() == [6 * i for i in range(20)]
            threading.Timer(0.05, gate.set).start()
            steps.of(late)
            steps.of(failing)()

    with pytest.raises(ValueError, match="step"):
        everything()
    assert done == [1]
    assert any(name.startswith("adjust") for name in names) == (threads == "3")


def test_who_asks_for_a_step_that_nobody_has_begun_does_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """And parts are shared out to no more threads than there are cores left."""
    monkeypatch.setenv("LABSURVEY_THREADS", "2")
    begun, gate, names = threading.Event(), threading.Event(), list[str]()

    def named() -> str:
        return threading.current_thread().name

    def waiting() -> str:
        begun.set()
        assert gate.wait(5.0)
        return named()

    with Beside() as steps:
        first = steps.of(waiting)
        assert begun.wait(5.0)
        second = steps.of(named)
        assert second() == named()
        names += side_by_side(lambda _: named(), range(50))
        gate.set()
        assert first().startswith("stage")
    assert set(names) == {named()}
    with pytest.raises(ValueError, match="0"):
        side_by_side(_failing, range(50))


def _failing(i: int) -> int:
    raise ValueError(str(i))


def test_a_forked_process_begins_threads_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of its parent are not there: steps given to them would never be done."""
    monkeypatch.setenv("LABSURVEY_THREADS", "2")

    def both() -> int:
        with Beside() as steps:
            return steps.of(lambda: sum(side_by_side(lambda i: i, range(4))))()

    assert both() == 6
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the threads there are wait for work
        pid = os.fork()
    if not pid:
        os._exit(both())
    for _ in range(1000):
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            break
        time.sleep(0.01)
    else:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        pytest.fail("the forked process waits for threads that it does not have")
    assert os.waitstatus_to_exitcode(status) == 6
