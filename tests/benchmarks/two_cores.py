"""How long a command would take on two cores that nobody else uses, from what the kernel scheduled on a busy machine.

``python -m tests.benchmarks.two_cores adjust LAB``, as root, where ``/sys/kernel/tracing`` can be written to. Every
time that a thread of the command ran, slept and woke another is recorded; the same is then played again on free cores:
what others took of the processor is gone, the order in which threads waited for each other stays. What the disk takes
is counted as it was. Each with one thread and with two, in turn, ``--rounds`` times.
"""

import argparse
import heapq
import os
import re
import subprocess
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

CORES, SLICE_S = 2, 0.003
TRACING = Path("/sys/kernel/tracing/instances/two_cores")
_EVENTS = ("sched_switch", "sched_waking", "sched_wakeup_new")
_LINE = re.compile(r"^\s*.+-(\d+)\s+\[\d+\]\s+(\S+)\s+([\d.]+): (\w+): (.*)$")
_LOCK_S = 0.05  # waits for the interpreter's lock time out again and again: only what ends them counts


@contextmanager
def traced() -> Iterator[list[str]]:
    """The scheduler's events while something runs, one a line, into the list when it is over."""
    lines: list[str] = []
    TRACING.mkdir(exist_ok=True)
    try:
        (TRACING / "trace_clock").write_text("mono")
        (TRACING / "buffer_size_kb").write_text("16384")
        for event in _EVENTS:
            (TRACING / f"events/sched/{event}/enable").write_text("1")
        yield lines
        (TRACING / "tracing_on").write_text("0")
        lines += (TRACING / "trace").read_text(errors="replace").splitlines()
    finally:
        TRACING.rmdir()


@dataclass
class Thread:
    """What a thread did: ("run", seconds), ("sleep", seconds), ("wake", number of a waking) or ("wait", the same)."""

    done: list[tuple[str, float]] = field(default_factory=list)
    since: float | None = None
    blocked: float | None = None

    def ran(self, now: float) -> None:
        """It has run until now."""
        if self.since is not None and now > self.since:
            self.done.append(("run", now - self.since))
            self.since = now


def threads_of(process: int, lines: Sequence[str]) -> dict[int, Thread]:
    """All threads of a process, the first first."""
    events = [(float(m[3]), int(m[1]), m[2], m[4], m[5]) for m in map(_LINE.match, lines) if m]
    found, n_wakings = {process: Thread()}, 0
    for now, by, flags, event, said in events:
        waker = found.get(by) if not set(flags) & set("hHs") else None  # else an interrupt, whoever ran
        if event == "sched_switch":
            last, state, following = (re.search(rf"{x}=(\S+)", said)[1] for x in ("prev_pid", "prev_state", "next_pid"))
            if (one := found.get(int(last))) is not None and one.since is not None:
                one.ran(now)
                one.since, one.blocked = None, None if state.startswith("R") else now
            if (one := found.get(int(following))) is not None:
                if one.blocked is not None:  # who woke it was not seen
                    one.done.append(("sleep", now - one.blocked))
                one.since, one.blocked = now, None
            continue
        woken = int(re.search(r" pid=(\d+)", said)[1])
        if event == "sched_wakeup_new" and waker is not None:
            found[woken] = Thread(blocked=now)
        one = found.get(woken)
        if one is None or one.blocked is None:
            continue
        if waker is not None and waker is not one and waker.since is not None:
            waker.ran(now)
            n_wakings += 1
            waker.done.append(("wake", n_wakings))
            one.done.append(("wait", n_wakings))
        else:
            one.done.append(("sleep", now - one.blocked))
        one.blocked = None
    for one in found.values():
        _forget_timeouts(one.done)
    return found


def _forget_timeouts(done: list[tuple[str, float]]) -> None:
    """Sleeps that were but parts of a wait for another thread take no time of their own."""
    ends = False
    for i in reversed(range(len(done))):
        kind, value = done[i]
        if kind == "sleep":
            ends = ends and value < _LOCK_S
            done[i] = (kind, 0.0 if ends else value)
        elif kind == "wait" or (kind == "run" and value > 3e-4):
            ends = kind == "wait"


def replayed(threads: dict[int, Thread], process: int) -> float:
    """When the first thread ends, s, on free cores."""
    at, left, woken = dict.fromkeys(threads, 0), dict[int, float](), set[float]()
    ready, waiting, asleep, running = deque[int](), dict[float, int](), list[tuple[float, int]](), list[list[float]]()
    now = end = 0.0

    def advance(thread: int) -> None:
        done = threads[thread].done
        while at[thread] < len(done):
            kind, value = done[at[thread]]
            if kind == "run":
                left[thread] = value
                ready.append(thread)
                return
            if kind == "wait" and value not in woken:
                waiting[value] = thread
                return
            at[thread] += 1
            if kind == "sleep":
                heapq.heappush(asleep, (now + value, thread))
                return
            if kind == "wake":
                woken.add(value)
                if (other := waiting.pop(value, None)) is not None:
                    advance(other)

    for thread in threads:
        advance(thread)
    while ready or asleep or running:
        while ready and len(running) < CORES:
            some = min(SLICE_S, left[ready[0]])
            running.append([now + some, ready.popleft(), some])
        now = min([x[0] for x in running] + [x[0] for x in asleep[:1]])
        while asleep and asleep[0][0] <= now:
            advance(heapq.heappop(asleep)[1])
        over, running = [x for x in running if x[0] <= now], [x for x in running if x[0] > now]
        for _, thread, some in over:
            end = now if thread == process else end
            left[thread] -= some
            if left[thread] > 1e-12:
                ready.append(thread)
            else:
                at[thread] += 1
                advance(thread)
    return end


def measured(command: Sequence[str], n_threads: int) -> tuple[float, float]:
    """Seconds of the processor, and those that would pass on free cores."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    environment |= {"LABSURVEY_THREADS": str(n_threads), "OPENBLAS_NUM_THREADS": "1"}
    with traced() as lines:
        run = subprocess.Popen([sys.executable, "-m", "survey", *command, "--quiet"], env=environment,
                               stdout=subprocess.DEVNULL)  # fmt: skip
        if run.wait() not in (0, 3):
            raise RuntimeError(f"{' '.join(command)} failed")
    threads = threads_of(run.pid, lines)
    ran = sum(value for one in threads.values() for kind, value in one.done if kind == "run")
    return ran, replayed(threads, run.pid)


def main() -> None:
    """Prints every run, and the least of each."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.two_cores", description=__doc__)
    parser.add_argument("command", nargs="+", help="of labsurvey")
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    least = {1: float("inf"), 2: float("inf")}
    for _ in range(given.rounds):
        for n_threads in least:
            cpu, passed = measured(given.command, n_threads)
            least[n_threads] = min(least[n_threads], passed)
            print(f"{n_threads} threads: {cpu:.2f} s of the processor, {passed:.2f} s on two free cores", flush=True)
    print(f"least: {least[1]:.2f} and {least[2]:.2f} s, {least[1] / least[2]:.2f} times faster by two threads")


if __name__ == "__main__":
    main()
