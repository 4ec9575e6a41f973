"""Builds the native library with sanitizers of addresses and undefined behaviour and checked indices, and tests it.

    python tests/native_checked.py                          # the tests of the kernels, with the widest vectors here
    python tests/native_checked.py --vectors base -k lens tests/adjust/test_lens_kernels.py
    python tests/native_checked.py -m tests.adjust.native_fuzz --seconds 60

What is not an option of this script goes to pytest; after ``-m``, to a module. Needs g++ with its sanitizers, Linux.
The build and a copy of the packages are in ``build/checked``; what is installed stays as it is. Only the set of vector
instructions that runs is built so; the plain ``base`` beside it says what the processor can do. What a sanitizer finds
ends the run with its report; an index outside its array ends it with a line that says so.
"""

import argparse
import ctypes
import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "build_tools"))
from native import NativeBuild, instruction_sets  # noqa: E402 - found behind the path above

PLACE = ROOT / "build" / "checked"
TESTS = (
    "adjust/test_native.py", "adjust/test_native_fuzz.py", "adjust/test_lens_kernels.py", "adjust/test_lens.py",
    "adjust/test_core_bundle.py", "adjust/test_core_jacobians.py", "adjust/test_core_precision.py",
    "adjust/test_image_reduction.py", "adjust/test_image_segments.py", "adjust/test_navigation.py",
    "adjust/test_pose_network.py", "adjust/test_pair_normals.py", "adjust/test_long_corridors.py",
    "survey/test_detection.py", "survey/test_detection_spots.py", "survey/test_rendering.py",
)  # fmt: skip


def main() -> int:
    """Build, then run; the exit code of the run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vectors", help="base, avx2 or avx512; by default what the processor can do best")
    parser.add_argument("-m", dest="module", help="run this module instead of pytest")
    arguments, others = parser.parse_known_args()
    for name in ("adjust", "survey", "capture", "tests"):
        ignored = shutil.ignore_patterns("__pycache__", "*.so")
        shutil.copytree(ROOT / name, PLACE / "lib" / name, ignore=ignored, dirs_exist_ok=True)
    _build(arguments.vectors, PLACE / "lib" / "adjust" / "native")
    shutil.copy2(ROOT / "setup.cfg", PLACE / "lib")
    if arguments.module:
        words = ["-m", arguments.module, *others]
    else:
        chosen = [] if any(word.split("::")[0].endswith(".py") for word in others) else [f"tests/{t}" for t in TESTS]
        words = ["-m", "pytest", "-p", "no:cacheprovider", *others, *chosen]
    return subprocess.run([sys.executable, *words], cwd=PLACE / "lib", env=_environment(arguments.vectors)).returncode


def _build(vectors: str | None, place: Path) -> None:
    for old in place.glob("kernels_*.so"):
        old.unlink()
    plain = Path(shutil.copy2(_installed(), place))
    widest = ctypes.CDLL(str(plain)).widest_instructions()
    name = vectors or list(instruction_sets())[widest]
    os.environ.setdefault("CXX", "g++")
    os.chdir(ROOT)
    NativeBuild(checked=True).run({name: place / f"kernels_{name}.so"})


def _installed() -> Path:
    """The library ``base`` as it is used: in the checkout, or where the packages were installed."""
    inside = ROOT / "adjust" / "native" / "kernels_base.so"
    return inside if inside.exists() else Path(find_spec("adjust.native").origin).with_name(inside.name)


def _environment(vectors: str | None) -> dict[str, str]:
    """The sanitizers' own libraries come first: Python itself was built without them."""
    compiler = os.environ.get("CXX", "g++")
    found = [
        subprocess.run([compiler, f"-print-file-name={name}"], capture_output=True, text=True, check=True).stdout
        for name in ("libasan.so", "libubsan.so", "libstdc++.so")
    ]
    more = {
        "LD_PRELOAD": " ".join(str(Path(f.strip()).resolve()) for f in found),
        "ASAN_OPTIONS": "detect_leaks=0:handle_segv=1",  # Python keeps what it has
        "UBSAN_OPTIONS": "print_stacktrace=1",
        "LABSURVEY_DATA": os.environ.get("LABSURVEY_DATA", str(ROOT.parent / "shared" / "data")),
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONPATH": str(PLACE / "lib"),
    }
    return os.environ | more | ({"LABSURVEY_VECTORS": vectors} if vectors else {})


if __name__ == "__main__":
    sys.exit(main())
