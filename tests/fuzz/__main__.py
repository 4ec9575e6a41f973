"""Fuzz readers with damaged versions of good files, each reader in a process of its own.

    python -m tests.fuzz                                # every reader, 1000 inputs each
    python -m tests.fuzz --reader gama,lgc --count 100000 --seed 7 --findings /tmp/findings
    python -m tests.fuzz --count 20000 --cpu-s 10       # many of what is read fast, fewer of the rest
    python -m tests.fuzz --replay tests/fuzz/corpus     # what was found before

Exit code 1 where anything was found. A finding is kept as a file, with the message beside it.
"""

import argparse
import itertools
import json
import math
import multiprocessing
import os
import sys
import tempfile
import time
import traceback
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path

from adjust.model.errors import SurveyError
from tests.fuzz.called import functions_called
from tests.fuzz.mutate import Mutator
from tests.fuzz.readers import READERS
from tests.fuzz.watch import ForbiddenError, HangError, Watch, limit_memory

CORPUS = Path(__file__).parent / "corpus"
_FORK = multiprocessing.get_context("fork")
_MEMORY = 1_500_000_000
_MOST_KEPT = 3  # inputs of the same finding


def main() -> int:
    """Run; the exit code."""
    parser = argparse.ArgumentParser("python -m tests.fuzz", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument("--reader", default=",".join(READERS), help="names, with commas between")
    parser.add_argument("--count", type=int, default=1000, help="inputs for each reader")
    parser.add_argument("--cpu-s", type=float, default=math.inf, help="most of the processor for each reader")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--limit-s", type=float, default=5.0, help="for one input")
    parser.add_argument("--findings", type=Path, default=Path(tempfile.gettempdir()) / "labsurvey-findings")
    parser.add_argument("--replay", type=Path, help="corpus folder: read its inputs once instead of new ones")
    parser.add_argument("--called", type=Path, help="write which functions of the packages read the good files")
    parser.add_argument("--jobs", type=int, default=1, help="readers at the same time")
    arguments = parser.parse_args()
    names = arguments.reader.split(",")
    unknown = set(names) - set(READERS)
    if unknown:
        parser.error(f"no such reader: {', '.join(sorted(unknown))}; there are {', '.join(READERS)}")
    arguments.findings.mkdir(parents=True, exist_ok=True)
    for name in names:
        READERS[name].seeds()  # imports and examples once, before the processes part
    begin = time.perf_counter()
    with ThreadPoolExecutor(arguments.jobs) as pool:
        results = list(pool.map(lambda name: outside(name, arguments), names))
    if arguments.called:
        called = sorted(set().union(*(r["called"] for r in results)))
        arguments.called.write_text(json.dumps(called, indent=0), encoding="utf-8")
    total, found = sum(r["inputs"] for r in results), sum(len(r["findings"]) for r in results)
    print(f"{total} inputs, {found} findings, seed {arguments.seed}, {time.perf_counter() - begin:.0f} s, "
          f"findings in {arguments.findings}")  # fmt: skip
    return 1 if found else 0


def outside(name: str, arguments: argparse.Namespace) -> dict:
    """One reader in a process of its own, because it may take its process down."""
    begin = time.perf_counter()
    ours, theirs = _FORK.Pipe(duplex=False)
    process = _FORK.Process(target=_inside, args=(name, arguments, theirs))
    process.start()
    theirs.close()
    try:
        result = ours.recv()
    except EOFError:
        result = None
    process.join()
    if result is None:
        kept = arguments.findings / name
        result = {"inputs": 0, "refused": 0, "slowest_s": 0.0, "called": [],
                  "findings": {f"process ended with {process.exitcode}, see {kept}.log": 1}}  # fmt: skip
    lines = [f"{name:<40}{result['inputs']:>9} inputs {result['refused']:>9} refused "
             f"{time.perf_counter() - begin:>8.1f} s   slowest {result['slowest_s']:.2f} s"]  # fmt: skip
    print("\n".join(lines + [f"    {count} x {what}" for what, count in result["findings"].items()]), flush=True)
    return result


def _inside(name: str, arguments: argparse.Namespace, answer: Connection) -> None:
    log = os.open(arguments.findings / f"{name}.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(log, 2)  # OpenCV's decoders say a lot
    answer.send(fuzz(name, arguments))


def fuzz(name: str, arguments: argparse.Namespace) -> dict:
    """All inputs of one reader in this process: what was found before, then new ones."""
    reader = READERS[name]
    kept = arguments.findings / name
    kept.mkdir(parents=True, exist_ok=True)
    shm = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shm if shm.is_dir() else None, prefix="fuzz-") as folder:
        place = Path(folder).resolve()
        read = reader.prepare(place)
        seeds = reader.seeds()
        called = functions_called(read, seeds)  # and imports what is imported late
        watch = Watch(place, arguments.limit_s)
        limit_memory(_MEMORY)
        if arguments.replay:
            inputs = [p.read_bytes() for p in sorted((arguments.replay / name).glob("*")) if p.is_file()]
        else:
            corpus = _corpus(name)
            mutator = Mutator([*seeds, *corpus], arguments.seed, reader.is_text, reader.dictionary)
            end = time.process_time() + arguments.cpu_s
            made = (mutator.next() for _ in range(arguments.count))
            inputs = itertools.chain(corpus, itertools.takewhile(lambda _: time.process_time() < end, made))
        return _loop(inputs, read, watch, kept) | {"called": called}


def _loop(inputs, read, watch, kept) -> dict:
    n = refused = 0
    slowest = 0.0
    findings: dict[str, int] = {}
    last = (kept / "last-input").open("wb", buffering=0)
    for data in inputs:
        last.seek(0)
        last.truncate()
        last.write(data)
        n += 1
        begin = time.perf_counter()
        try:
            with watch.reading():
                read(data)
        except SurveyError:
            refused += 1
        except (Exception, ForbiddenError, HangError) as error:
            _keep(kept, _named(error), data, findings)
        slowest = max(slowest, time.perf_counter() - begin)
    last.close()
    (kept / "last-input").unlink()
    return {"inputs": n, "refused": refused, "slowest_s": slowest, "findings": findings}


def _named(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if "/survey/" in f.filename or "/adjust/" in f.filename or "/capture/" in f.filename]
    at = (ours or frames)[-1]
    return f"{type(error).__name__} at {Path(at.filename).name}:{at.lineno}: {str(error)[:110]!r}"


def _keep(kept: Path, what: str, data: bytes, findings: dict[str, int]) -> None:
    known = next((k for k in findings if k.split(": ")[0] == what.split(": ")[0]), what)
    findings[known] = findings.get(known, 0) + 1
    if findings[known] <= _MOST_KEPT:
        place = list(findings).index(known)
        (kept / f"{place:02d}-{findings[known]}").write_bytes(data)
        (kept / f"{place:02d}.txt").write_text(what + "\n", encoding="utf-8")


def _corpus(name: str) -> list[bytes]:
    return [p.read_bytes() for p in sorted((CORPUS / name).glob("*")) if p.is_file()]


if __name__ == "__main__":
    sys.exit(main())
