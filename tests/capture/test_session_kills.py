"""Sessions killed at random instants, and at every single one that matters, lose nothing and take nothing twice."""

import signal
from itertools import count

import pytest

from tests.capture.session_runs import kill_runs, processes, require_complete, run_to_end, run_until_fsync, write_plan
from tests.capture.table_server import table_server

pytestmark = pytest.mark.slow


def test_killed_at_random_instants(tmp_path):
    """The benchmark ``capture_faults`` does the same 50 times."""
    with table_server(tmp_path, "--speed", "2000", "--acceleration", "100000") as server:
        counts = kill_runs(tmp_path, server.url, 15, seed=1)
    assert counts["kills"] == 15


def test_killed_before_every_fsync(tmp_path):
    """All moments between two states of the disk, one after the other, for two epochs of a camera."""
    context = processes()
    for number in count(1):
        home = tmp_path / str(number)
        home.mkdir()
        plan = write_plan(home, table=False, n=(1, 2), cameras=("X",))
        process = context.Process(target=run_until_fsync, args=(str(plan), number))
        process.start()
        process.join(120)
        if process.exitcode == 0:
            break
        assert process.exitcode == -signal.SIGKILL
        assert run_to_end(context, plan) == 0
        require_complete(plan, 2, ("X",))
    assert number > 8  # every image: its file and its folder; every line of the journal
