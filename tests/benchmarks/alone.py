"""How much faster two threads are on two cores, told by the scheduler: other work on the machine does not matter.

``python -m tests.benchmarks.alone adjust LAB --quiet``, on Linux with ``perf`` and the right to trace all processors.
What runs of the command while no other thread of it runs or waits for a processor counts whole, all else half.
"""

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable

EVENTS = "sched:sched_switch,sched:sched_wakeup,sched:sched_process_fork,sched:sched_process_exec"
_LINE = re.compile(r"\s*(\d+)\s+\[(\d+)\]\s+([\d.]+):\s+sched:(\w+):\s+(.*)")
_FORK, _WAKE = re.compile(r"child_pid=(\d+)"), re.compile(r" pid=(\d+)")
_SWITCH = re.compile(r"prev_pid=(\d+) .*prev_state=(\S+) ==> .*next_pid=(\d+)")


def traced(command: list[str], threads: int) -> tuple[int, list[re.Match[str]]]:
    """The process of a command, and what the scheduler did meanwhile."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    environment |= {"LABSURVEY_THREADS": str(threads), "OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as place:
        data = f"{place}/perf.data"
        record = ["perf", "record", "-q", "-e", EVENTS, "-a", "-m", "4096", "-o", data, "--"]
        run = [sys.executable, "-m", "survey", *command]
        subprocess.run(record + run, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)
        said = subprocess.run(["perf", "script", "-i", data, "--ns", "-F", "tid,cpu,time,event,trace"], text=True,
                              capture_output=True, check=True)  # fmt: skip
    events = list(filter(None, map(_LINE.match, said.stdout.splitlines())))
    begun = f"filename={sys.executable} "
    return next(int(e[1]) for e in events if e[4] == "sched_process_exec" and e[5].startswith(begun)), events


def seconds(process: int, events: Iterable[re.Match[str]]) -> tuple[float, float]:
    """Of all threads of a process: on the processors, and of that while no other could run."""
    mine, ready, running, before = {process}, set[int](), dict[str, int](), 0.0
    whole = alone = 0.0
    for event in events:
        thread, cpu, now, name, said = int(event[1]), event[2], float(event[3]), event[4], event[5]
        busy = [x for x in running.values() if x in mine]
        whole += len(busy) * (now - before)
        alone += (now - before) if len(busy) == 1 and not ready else 0.0
        before = now
        if name == "sched_process_fork" and thread in mine:
            mine.add(int(_FORK.search(said)[1]))
        elif name == "sched_wakeup" and (woken := int(_WAKE.search(said)[1])) in mine:
            ready |= {woken} - set(running.values())
        elif name == "sched_switch":
            last, state, following = _SWITCH.search(said).groups()
            ready.discard(int(last))
            if int(last) in mine and state.startswith("R"):
                ready.add(int(last))
            ready.discard(int(following))
            running[cpu] = int(following)
    return whole, alone


def main() -> None:
    """Prints both, and by how much two threads are faster."""
    times = []
    for threads in (1, 2):
        whole, alone = seconds(*traced(sys.argv[1:], threads))
        times.append(alone + 0.5 * (whole - alone))
        print(f"{threads} threads: {whole:.2f} s of the processors, {alone:.2f} alone, {times[-1]:.2f} s on two cores")
    print(f"{times[0] / times[1]:.2f} times")


if __name__ == "__main__":
    main()
