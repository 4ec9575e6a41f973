"""How the native library is built: with a compiler that only writes down what it is asked for."""

import os
import shutil
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
_COMPILER = r"""#!/bin/sh
[ "$*" = --version ] && { echo "wonders ${VERSION:-1}"; exit; }
words=$(printf '%s\t' "$@")
printf '%s\n' "$words" >> "$ASKED"
case $words in
    *"${REFUSED:-nothing}"*) echo "vision.cpp:3:1: error: unknown wonder"; exit 1;;
    *-fno-sanitize-recover=all*) made="made checked";;
    *) made=made;;
esac
while [ "$1" != -o ]; do shift; done
printf '%s' "$made" > "$2"
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A copy of what is built, and the compiler."""
    for name in ("adjust", "build_tools"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__", "*.so"))
    for name in ("setup.py", "setup.cfg", "pyproject.toml", "README.md", "LICENSE", "MANIFEST.in"):
        shutil.copy(ROOT / name, tmp_path)
    (tmp_path / "compiler").write_text(_COMPILER, encoding="utf-8")
    (tmp_path / "compiler").chmod(0o755)
    return tmp_path


def _run(place: Path, *words: str, **more: str) -> tuple[int, str, list[list[str]]]:
    """Exit code, what was printed, and what the compiler was asked for; ``setup.py`` with these words."""
    asked = place / "asked"
    asked.unlink(missing_ok=True)
    environment = {"CXX": str(place / "compiler"), "ASKED": str(asked)}
    done = subprocess.run([sys.executable, "setup.py", "-q", *words], cwd=place, env=os.environ | environment | more,
                          capture_output=True, text=True, check=False)  # fmt: skip
    calls = [line.split("\t")[:-1] for line in asked.read_text().splitlines()] if asked.exists() else []
    return done.returncode, done.stdout + done.stderr, calls


def _sources(calls: list[list[str]]) -> list[str]:
    return sorted(Path(c[c.index("-c") + 1]).name for c in calls if "-c" in c)


def _build(place: Path, **more: str) -> tuple[int, str, list[list[str]]]:
    return _run(place, "build_ext", "--inplace", **more)


def _sets(place: Path) -> int:
    return len(list((place / "adjust" / "native").glob("kernels_*.so")))


def test_only_what_has_changed_is_built_again(place: Path) -> None:
    code, text, calls = _build(place)
    assert code == 0, text
    sets = _sets(place)
    assert sets in (1, 3)
    assert _sources(calls).count("images.cpp") == sets
    assert _sources(calls).count("processor.cpp") == 1
    assert len([c for c in calls if "-shared" in c]) == sets
    assert not any("-march=native" in word for c in calls for word in c)
    header = place / "adjust/native/corners.h"  # included by vision.cpp alone
    os.utime(header, (time.time() + 10,) * 2)
    assert _build(place)[2] == []
    elsewhere = _run(place, "build_ext", "--build-lib", "lib", "--build-temp", "temp")  # as every pip install does
    assert elsewhere[0] == 0
    assert elsewhere[2] == []
    assert (place / "lib/adjust/native/kernels_base.so").read_bytes() == b"made"
    was = header.read_bytes()
    header.write_bytes(was + b"\n")
    assert set(_sources(_build(place)[2])) == {"vision.cpp"}
    header.write_bytes(was)
    assert _build(place)[2] == []
    assert len(_build(place, VERSION="2")[2]) == len(calls)  # another compiler of the same name


def test_other_flags_build_everything_again_and_elsewhere(place: Path) -> None:
    plain = _build(place)[2]
    checked = _build(place, LABSURVEY_NATIVE="checked")[2]
    built = place / "adjust" / "native" / "kernels_base.so"
    assert built.read_bytes() == b"made checked"
    assert len(checked) == len(plain)
    assert all(any(word.startswith("-fsanitize=address,undefined") for word in c) for c in checked)
    assert _build(place)[2] == []  # what is of the other kind is still there
    assert built.read_bytes() == b"made"
    kept = list((place / "build" / "native").iterdir())
    assert len(kept) == len(plain) + len(checked)
    for path in kept:
        os.utime(path, (0, 0))
    assert _build(place)[2] == []
    assert len(list((place / "build" / "native").iterdir())) == len(plain)  # what no build has used for a month goes


def test_a_failing_compiler_is_quoted_with_what_to_do(place: Path) -> None:
    code, text, calls = _build(place, REFUSED="vision.cpp")
    assert code == 1
    command = next(" ".join(c) for c in calls if "vision.cpp" in " ".join(c))
    assert command in text
    assert "vision.cpp:3:1: error: unknown wonder" in text
    assert "install one ('apt install g++'" in text
    assert "Traceback" not in text
    code, text, _ = _build(place, CXX="/nowhere/c++")
    assert code == 1
    assert "No such file or directory: '/nowhere/c++'" in text
    assert "name it (CXX=" in text


def test_the_wheel_is_for_a_platform_and_any_python(place: Path) -> None:
    stale = place / "adjust" / "native" / "kernels_base.so"
    stale.write_text("from an older or a checked build in place", encoding="utf-8")
    code, text, _ = _run(place, "bdist_wheel")
    assert code == 0, text
    (wheel,) = (place / "dist").glob("*.whl")
    assert wheel.name.split("-")[2:4] == ["py3", "none"]
    assert not wheel.name.endswith("any.whl")
    with zipfile.ZipFile(wheel) as file:
        held = [n for n in file.namelist() if n.startswith("adjust/native/")]
        about = next(n for n in file.namelist() if n.endswith(".dist-info/WHEEL"))
        assert "Root-Is-Purelib: false" in file.read(about).decode()
        assert file.read("adjust/native/kernels_base.so") == b"made"
    assert {Path(n).suffix for n in held} == {".py", ".so"}


def test_the_source_distribution_has_what_is_compiled(place: Path) -> None:
    code, text, _ = _run(place, "sdist", "--formats=zip")
    assert code == 0, text
    (source,) = (place / "dist").glob("*.zip")
    with zipfile.ZipFile(source) as file:
        held = {n.partition("/")[2] for n in file.namelist()}
    native = {p.relative_to(place).as_posix() for p in (place / "adjust" / "native").glob("*.[hc]*")}
    assert native <= held
    assert {"setup.py", "build_tools/backend.py", "build_tools/native.py"} <= held
    assert not any(n.endswith(".so") for n in held)


_BACKEND = "import backend; print(backend.compiler(), *backend.get_requires_for_build_wheel())"


def test_a_compiler_is_asked_for_where_none_is_able(tmp_path: Path) -> None:
    def asked(path: str, **more: str) -> str:
        environment = {"PATH": path, "PYTHONPATH": str(ROOT / "build_tools")} | more
        done = subprocess.run([sys.executable, "-c", _BACKEND], cwd=ROOT, env=environment, capture_output=True,
                              text=True, check=True)  # fmt: skip
        return done.stdout

    assert "None ziglang" in asked(str(tmp_path))
    old = tmp_path / "c++"
    old.write_text("#!/bin/sh\nexit 1\n", encoding="utf-8")  # knows no C++20
    old.chmod(0o755)
    assert "None ziglang" in asked(str(tmp_path))
    old.write_text("#!/bin/sh\nexit 0\n", encoding="utf-8")
    assert "['c++']" in asked(str(tmp_path))
    assert "ziglang" not in asked(str(tmp_path))
    assert "['/some/where/c++', '-m64']" in asked("", CXX="/some/where/c++ -m64")
