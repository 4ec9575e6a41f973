"""Builds the wheel, installs it far from the checkout in a fresh environment, and tries what a new user tries.

    python tests/packaging_smoke.py                                     # this interpreter, newest dependencies
    python tests/packaging_smoke.py --python python3.13 --python ~/.pyenv/versions/3.12.1/bin/python
    python tests/packaging_smoke.py --lowest --extras all               # exactly the lower bounds of setup.cfg
    python tests/packaging_smoke.py --tests tests/test_conventions.py   # and some tests against what is installed

Needs the package index. Prints a line for each step; exit code 1 where one fails.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
from tests.lower_bounds import build_requirements, chosen, pins, requirements  # noqa: E402  # found by the line above

_IMPORTS = "import adjust, survey, capture; print(adjust.__file__)"
_COMMANDS = (
    "labsurvey --help", "labsurvey --version", "labcapture --help", "labsurvey example total-station lab",
    "labsurvey adjust lab", "labsurvey report lab --language de", "labsurvey convert lab lab.snx",
    "labsurvey example relay relay", "labsurvey adjust relay --json", "labsurvey completion bash", "labcapture cameras",
)  # fmt: skip
_SHIPPED = (
    *("adjust/py.typed", "survey/py.typed", "capture/py.typed"),
    *("survey/report/style.css", "survey/report/web/report.js", "survey/report/web/de.json"),
    *("capture/web/page.html", "capture/devices/turntables/dialects/two-axis.toml"),
    *("survey/report/templates/parts.html", "survey/report/catalogues/de.toml"),
)
_BUILT_FROM = (
    "LICENSE", "README.md", "setup.py", "build_tools/backend.py", "build_tools/native.py", "adjust/native/lenses.h",
    "adjust/native/images.cpp",
)  # fmt: skip


def main() -> int:
    """Run for every interpreter; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", action="append", help="interpreter, more than once for more")
    parser.add_argument("--lowest", action="store_true", help="dependencies at their lower bounds, not the newest")
    parser.add_argument("--extras", default="", help="with commas between, or all")
    parser.add_argument("--tests", nargs="*", default=[], help="tests to run against what is installed")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="packaging-") as name:
        place = Path(name)
        failed = [p for p in arguments.python or [sys.executable] if not _try(p, place, arguments)]
    print(f"failed: {', '.join(failed)}" if failed else "all passed")
    return 1 if failed else 0


class _StepError(Exception):
    """A step failed; its output was printed."""


def _step(command: list[str], cwd: Path, **more: str) -> str:
    begin = time.perf_counter()
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV", "PYTHONHOME")}
    done = subprocess.run(command, cwd=cwd, env=environment | more, capture_output=True, text=True, check=False)
    shown = " ".join(str(word).replace(str(cwd), ".") for word in command)
    word = "ok    " if done.returncode == 0 else "FAILED"
    print(f"  {word} {time.perf_counter() - begin:6.1f} s  {shown}", flush=True)
    if done.returncode != 0:
        print(done.stdout[-3000:] + done.stderr[-6000:])
        raise _StepError
    return done.stdout


def _try(python: str, place: Path, arguments: argparse.Namespace) -> bool:
    python = str(Path(python).expanduser())
    folder = Path(tempfile.mkdtemp(dir=place))
    print(f"{subprocess.run([python, '-V'], capture_output=True, text=True, check=True).stdout.strip()}  {python}")
    try:
        _smoke(python, folder, arguments)
    except _StepError:
        return False
    return True


def _smoke(python: str, folder: Path, arguments: argparse.Namespace) -> None:
    constraints, build = folder / "constraints.txt", folder / "build.txt"
    extras = [e for e in arguments.extras.split(",") if e]
    constraints.write_text("\n".join(pins(requirements(extras))) + "\n" if arguments.lowest else "")
    build.write_text("\n".join(pins(build_requirements())) + "\n" if arguments.lowest else "")
    _step([python, "-m", "venv", "env"], folder)
    bin = folder / "env" / "bin"
    pip = [str(bin / "python"), "-m", "pip", "--disable-pip-version-check", "-q"]
    _step([*pip, "install", "build"], folder)
    source = _committed(folder / "source")
    _step([str(bin / "python"), "-m", "build", "--outdir", str(folder / "dist"), str(source)], folder,
          PIP_CONSTRAINT=str(build))  # fmt: skip
    shutil.rmtree(source)
    wheel = _checked(folder / "dist")
    wanted = f"{wheel}[{','.join(chosen(extras))}]" if extras else str(wheel)
    _step([*pip, "install", "-c", str(constraints), wanted], folder)
    _step([*pip, "check"], folder)
    where = _step([str(bin / "python"), "-c", _IMPORTS], folder).strip()
    if not where.startswith(str(folder)):
        print(f"  FAILED imported from {where}")
        raise _StepError
    for command in _COMMANDS:
        program, *words = command.split()
        _step([str(bin / program), *words], folder)
    if arguments.tests:
        _tests(pip, bin, folder, arguments)


def _committed(target: Path) -> Path:
    """What is committed: what a release is built from."""
    target.mkdir()
    archive = target.with_suffix(".tar")
    subprocess.run(["git", "archive", "-o", str(archive), "HEAD"], cwd=ROOT, check=True)
    with tarfile.open(archive) as file:
        file.extractall(target, filter="data")
    return target


def _checked(dist: Path) -> Path:
    """The wheel, once it and the source distribution hold what is needed and nothing that runs at install time."""
    (wheel,), (source,) = dist.glob("*.whl"), dist.glob("*.tar.gz")
    held = set(zipfile.ZipFile(wheel).namelist())
    with tarfile.open(source) as archive:
        sent = {n.partition("/")[2] for n in archive.getnames()}
    problems = [f"wheel lacks {n}" for n in (*_SHIPPED, "adjust/native/kernels_base.so") if n not in held]
    problems += [] if "-py3-none-" in wheel.name else [f"{wheel.name} is for one Python alone"]
    problems += [f"source distribution lacks {n}" for n in (*_SHIPPED, *_BUILT_FROM) if n not in sent]
    problems += [f"wheel holds {n}" for n in held if n.split("/")[0] in ("tests", "docs", "examples", "build")]
    if problems:
        print("\n".join(f"  FAILED {p}" for p in problems))
        raise _StepError
    return wheel


def _tests(pip: list[str], bin: Path, folder: Path, arguments: argparse.Namespace) -> None:
    """The tests stand alone in a folder, so that they meet what is installed."""
    _step([*pip, "install", "-c", str(folder / "constraints.txt"), "pytest"], folder)
    shutil.copytree(ROOT / "tests", folder / "tests", ignore=shutil.ignore_patterns("__pycache__", "benchmarks"))
    shutil.copy2(ROOT / "setup.cfg", folder / "setup.cfg")
    out = _step([str(bin / "python"), "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments.tests], folder)
    print(f"         {out.strip().splitlines()[-1]}")


if __name__ == "__main__":
    sys.exit(main())
