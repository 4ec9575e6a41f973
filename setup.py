"""The native library: one shared object for each set of vector instructions, plain C functions, for every Python.

The metadata is in ``setup.cfg``. ``LABSURVEY_NATIVE=checked`` builds with sanitizers and checked indices instead.
"""

import os
import platform
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

sys.path.insert(0, str(Path(__file__).parent / "build_tools"))
from backend import compiler

SOURCES = Path("adjust/native")
FLAGS = ["-std=c++20", "-O2", "-g0", "-fPIC", "-fvisibility=hidden", "-fno-exceptions", "-fno-rtti", "-fno-math-errno",
         "-fno-trapping-math", "-ffp-contract=fast", "-fno-strict-aliasing", "-Wno-ignored-attributes", "-Wno-psabi",
         "-Wno-unused-function"]  # fmt: skip
CHECKED = ["-std=c++20", "-O1", "-g", "-fPIC", "-fvisibility=hidden", "-fno-exceptions", "-fno-rtti", "-DCHECKED",
           "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-Wno-ignored-attributes", "-Wno-psabi",
           "-Wno-unused-function"]  # fmt: skip
AVX2 = ["-mavx2", "-mfma"]
AVX512 = [*AVX2, "-mavx512f", "-mavx512dq", "-mavx512vl", "-mavx512bw"]
X86 = platform.machine() in ("x86_64", "AMD64")
SETS = {"base": []} | ({"avx2": AVX2, "avx512": AVX512} if X86 else {})


class Build(build_ext):
    """One compiler call for each source and set of instructions, side by side, and one link for each set."""

    def get_ext_filename(self, name):
        """The library's own name, without that of a Python."""
        return name.replace(".", "/") + ".so"

    def build_extensions(self):
        """Compile everything, then link each library."""
        found = compiler()
        zig = [sys.executable, "-m", "ziglang"]
        # linking by "zig c++" would first build a C++ library, which is not needed here
        compile_, link = (found, found) if found else ([*zig, "c++"], [*zig, "cc"])
        checked = os.environ.get("LABSURVEY_NATIVE") == "checked"
        flags = CHECKED if checked else FLAGS
        temp = Path(self.build_temp)
        temp.mkdir(parents=True, exist_ok=True)
        os.environ.setdefault("ZIG_GLOBAL_CACHE_DIR", str(temp.resolve() / "zig"))
        objects = {}
        for name, instructions in SETS.items():
            for source in sorted(SOURCES.glob("*.cpp")):
                if source.stem != "processor" or name == "base":
                    objects[temp / f"{source.stem}_{name}.o"] = [*compile_, *flags, *instructions, "-c", str(source)]
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(lambda item: self.spawn([*item[1], "-o", str(item[0])]), objects.items()))
        more = ["-fsanitize=address,undefined"] if checked else [] if sys.platform == "darwin" else ["-s"]
        for extension in self.extensions:
            name = extension.name.rpartition("_")[2]
            path = Path(self.get_ext_fullpath(extension.name))
            path.parent.mkdir(parents=True, exist_ok=True)
            mine = [str(o) for o in objects if o.stem.endswith(f"_{name}")]
            self.spawn([*link, "-shared", *mine, "-o", str(path), *more])


class Wheel(bdist_wheel):
    """A wheel for a platform, not for a Python."""

    def get_tag(self):
        """Any Python 3, no interface of it, this platform."""
        return "py3", "none", super().get_tag()[2]


setup(
    ext_modules=[Extension(f"adjust.native.kernels_{name}", []) for name in SETS],
    cmdclass={"build_ext": Build, "bdist_wheel": Wheel},
)
