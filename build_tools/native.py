"""Compiles and links the native library: which commands, what is kept, and what to say when a compiler fails."""

import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from hashlib import sha256
from pathlib import Path

from backend import compiler

SOURCES = Path("adjust/native")
ALWAYS = ["-std=c++20", "-fPIC", "-fvisibility=hidden", "-fno-exceptions", "-fno-rtti", "-Wall", "-Wextra"]
FLAGS = ["-O2", "-g0", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast", "-fno-strict-aliasing"]
SANITIZERS = ["-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all"]
CHECKED = ["-Og", "-g1", "-fno-omit-frame-pointer", "-DCHECKED", *SANITIZERS]
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
    """The build of all libraries, in ``checked`` form or that for use.

    What is compiled and linked is kept in the folder ``build/native`` of the sources, under the hash of its command,
    its sources and the compiler's version: no build does again what another one has done, wherever its result goes.
    """

    def __init__(self, checked: bool) -> None:
        self.kept = Path("build/native")
        self.kept.mkdir(parents=True, exist_ok=True)
        arch = shlex.split(os.environ.get("ARCHFLAGS", "")) if MAC else []
        found = compiler()
        zig = [sys.executable, "-m", "ziglang"]
        # linking by "zig c++" would first build a C++ library, which is not needed here
        self.compilers = (found, found) if found else ([*zig, "c++"], [*zig, "cc"])
        needed = [] if MAC else ["-Wl,--as-needed", *([] if checked else ["-s"])]
        self.compile = [*self.compilers[0], *ALWAYS, *(CHECKED if checked else FLAGS), *arch]
        self.link = [*self.compilers[1], "-shared", *arch, *needed, *(SANITIZERS if checked else [])]

    def run(self, libraries: dict[str, Path]) -> None:
        """Compile what is not kept, all at once, then link: the path of the library for each set of instructions."""
        with tempfile.TemporaryDirectory(dir=self.kept) as scratch, ThreadPoolExecutor(os.cpu_count()) as pool:
            self.scratch = Path(scratch).resolve()
            self.environment = self._environment()
            self.about = [_told([*c, "--version"], self.environment) for c in self.compilers]
            for (name, path), objects in [(x, pool.map(self._compiled, *_units(x[0]))) for x in libraries.items()]:
                command = [*self.link, *map(str, objects)]
                library = self._made(f"kernels_{name}", ".so", [], command, ["-lm"])
                path.parent.mkdir(parents=True, exist_ok=True)
                fresh = path.with_name(f"{path.name}.{os.getpid()}")
                shutil.copy(library, fresh)
                fresh.replace(path)  # at once: the former one may be in use
        for old in self.kept.glob("*.*o"):
            if old.stat().st_mtime < time.time() - 30 * 86400:  # no build has used it for a month
                old.unlink(missing_ok=True)

    def _environment(self) -> dict[str, str]:
        """What is said from outside holds."""
        more = {"ZIG_GLOBAL_CACHE_DIR": str(self.scratch), "ZIG_LOCAL_CACHE_DIR": str(self.scratch)}
        if MAC and (target := sysconfig.get_config_var("MACOSX_DEPLOYMENT_TARGET")):
            more["MACOSX_DEPLOYMENT_TARGET"] = str(target)
        return more | os.environ

    def _compiled(self, source: Path, name: str) -> Path:
        command = [*self.compile, *instruction_sets()[name], "-c", str(source)]
        return self._made(f"{source.stem}_{name}", ".o", _included(source), command, [])

    def _made(self, stem: str, ending: str, sources: list[Path], command: list[str], last: list[str]) -> Path:
        """The file of this command, made unless it is kept."""
        about = [command, last, self.about, self.environment.get("MACOSX_DEPLOYMENT_TARGET")]
        content = b"\0".join([repr(about).encode(), *(p.read_bytes() for p in sources)])
        path = self.kept / f"{stem}_{sha256(content).hexdigest()[:20]}{ending}"
        if path.exists():
            os.utime(path)
            return path
        fresh = self.scratch / path.name
        whole = [*command, "-o", str(fresh), *last]
        print(shlex.join(whole), flush=True)
        if told := _told(whole, self.environment):
            print(told, flush=True)
        return fresh.replace(path)


def _units(name: str) -> tuple[list[Path], list[str]]:
    """What is compiled for a set of instructions, and the set's name for each."""
    sources = [s for s in sorted(SOURCES.glob("*.cpp")) if s.stem != "processor" or name == "base"]
    return sources, [name] * len(sources)


def _told(command: list[str], environment: dict[str, str]) -> str:
    """What a command printed; ``CompilerError`` where it failed."""
    text = shlex.join(command)
    try:
        done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False)
    except OSError as error:
        raise CompilerError(_advice(text, str(error))) from None
    told = done.stdout.decode(errors="replace").strip()
    if done.returncode != 0:
        raise CompilerError(_advice(text, told or f"ended with code {done.returncode}"))
    return told


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
