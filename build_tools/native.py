"""Compiles and links the native library: which commands, what is up to date, and what to say when a compiler fails."""

import os
import platform
import re
import shlex
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

from backend import compiler

SOURCES = Path("adjust/native")
ALWAYS = ["-std=c++20", "-fPIC", "-fvisibility=hidden", "-fno-exceptions", "-fno-rtti", "-Wall", "-Wextra"]
FLAGS = ["-O2", "-g0", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast", "-fno-strict-aliasing"]
SANITIZERS = ["-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all"]
CHECKED = ["-O1", "-g", "-fno-omit-frame-pointer", "-DCHECKED", *SANITIZERS]
AVX2 = ["-mavx2", "-mfma"]
AVX512 = [*AVX2, "-mavx512f", "-mavx512dq", "-mavx512vl", "-mavx512bw"]
MAC = sys.platform == "darwin"


class CompilerError(Exception):
    """A compiler could not be started, or refused something."""


def machine() -> str:
    """The processor that is built for: that of Python, or of this machine where a Python has several."""
    name = sysconfig.get_platform().rpartition("-")[2]
    return platform.machine() if name == "universal2" else name


def instruction_sets() -> dict[str, list[str]]:
    """Sets of vector instructions, one library for each, and the compiler's flags for them."""
    return {"base": []} | ({"avx2": AVX2, "avx512": AVX512} if machine() in ("x86_64", "amd64", "AMD64") else {})


class NativeBuild:
    """The build of all libraries, with objects in the folder ``temp``, in ``checked`` form or that for use."""

    def __init__(self, temp: Path, checked: bool) -> None:
        self.temp = temp / ("checked" if checked else "native")
        self.temp.mkdir(parents=True, exist_ok=True)
        arch = shlex.split(os.environ.get("ARCHFLAGS", "")) if MAC else []
        found = compiler()
        zig = [sys.executable, "-m", "ziglang"]
        # linking by "zig c++" would first build a C++ library, which is not needed here
        self.compile, link = (found, found) if found else ([*zig, "c++"], [*zig, "cc"])
        self.compile = [*self.compile, *ALWAYS, *(CHECKED if checked else FLAGS), *arch]
        needed = [] if MAC else ["-Wl,--as-needed", *([] if checked else ["-s"])]
        self.link = [*link, "-shared", *arch, *needed, *(SANITIZERS if checked else [])]

    def run(self, libraries: dict[str, Path]) -> None:
        """Compile what is older than its sources, all at once, then link: the path of the library for each set."""
        flags = instruction_sets()
        objects = {
            self.temp / f"{source.stem}_{name}.o": (source, [*self.compile, *flags[name], "-c", str(source)])
            for name in libraries
            for source in sorted(SOURCES.glob("*.cpp"))
            if source.stem != "processor" or name == "base"
        }
        with tempfile.TemporaryDirectory(dir=self.temp) as cache_of_zig, ThreadPoolExecutor(os.cpu_count()) as pool:
            where = Path(cache_of_zig).resolve()
            more = {"ZIG_GLOBAL_CACHE_DIR": str(where), "ZIG_LOCAL_CACHE_DIR": str(where)}
            if MAC and (target := sysconfig.get_config_var("MACOSX_DEPLOYMENT_TARGET")):
                more["MACOSX_DEPLOYMENT_TARGET"] = str(target)
            environment = more | os.environ  # what is said from outside holds

            def compiled(item: tuple[Path, tuple[Path, list[str]]]) -> None:
                path, (source, command) = item
                _made(path, _included(source), command, environment)

            def linked(item: tuple[str, Path]) -> None:
                name, path = item
                mine = [o for o in objects if o.stem.endswith(f"_{name}")]
                path.parent.mkdir(parents=True, exist_ok=True)
                command = [*self.link, *map(str, mine)]
                _made(path, mine, command, environment, self.temp.parent / f"{name}.command", ["-lm"])

            list(pool.map(compiled, objects.items()))
            list(pool.map(linked, libraries.items()))


def _made(
    path: Path, sources: list[Path], command: list[str], environment: dict[str, str], record: Path | None = None,
    last: list[str] | None = None,
) -> None:  # fmt: skip
    """Make a file, unless it is newer than its sources and was made by the same command."""
    whole = [*command, "-o", str(path), *(last or [])]
    record = record or path.with_suffix(".command")
    text = shlex.join(whole)
    if path.exists() and record.exists() and record.read_text(encoding="utf-8") == text:
        made = path.stat().st_mtime_ns
        if all(s.stat().st_mtime_ns < made for s in sources):
            return
    record.unlink(missing_ok=True)
    print(text, flush=True)
    try:
        done = subprocess.run(whole, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False)
    except OSError as error:
        raise CompilerError(_advice(text, str(error))) from None
    told = done.stdout.decode(errors="replace").strip()
    if done.returncode != 0:
        raise CompilerError(_advice(text, told or f"ended with code {done.returncode}"))
    if told:
        print(told, flush=True)
    record.write_text(text, encoding="utf-8")


def _advice(command: str, told: str) -> str:
    return (
        f"the native library could not be built. This command failed:\n\n    {command}\n\n{told}\n\n"
        "g++ 11 or clang 14, or newer, can build it: install one ('apt install g++', 'dnf install gcc-c++', "
        "'xcode-select --install') or name it (CXX=clang++ pip install .). Where none is found, the package ziglang is "
        "fetched for the build alone."
    )


@cache
def _included(path: Path) -> list[Path]:
    """A source and all of the project's headers that it includes."""
    return list(dict.fromkeys(_headers(path)))


def _headers(path: Path) -> Iterator[Path]:
    yield path
    for name in re.findall(r'^#include "(.+)"', path.read_text(encoding="utf-8"), re.MULTILINE):
        yield from _headers(path.parent / name)
