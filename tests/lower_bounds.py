"""Prints the lower bounds of setup.cfg as pip's constraints: ``python tests/lower_bounds.py [EXTRA...]``.

The bounds of the core, of the extras named (``all``: of those that people install, without ``test`` and ``docs``), and
with ``--build`` those of the build system instead.
"""

import configparser
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
_NOT_FOR_USERS = ("test", "docs")


def _setup() -> configparser.ConfigParser:
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg", encoding="utf-8")
    return setup


def chosen(extras: Iterable[str]) -> list[str]:
    """The extras named, or all of those for users."""
    declared = _setup()["options.extras_require"]
    return [name for name in declared if name not in _NOT_FOR_USERS] if "all" in extras else list(extras)


def requirements(extras: Iterable[str]) -> Iterator[str]:
    """Requirement lines of the core and of some extras."""
    setup = _setup()
    declared = (setup["options.extras_require"][name] for name in chosen(extras))
    for text in (setup["options"]["install_requires"], *declared):
        yield from (line.strip() for line in text.split("\n") if line.strip())


def build_requirements() -> Iterator[str]:
    """Requirement lines of the build system."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        yield from tomllib.load(file)["build-system"]["requires"]


def pins(lines: Iterable[str]) -> list[str]:
    """``name==lowest`` of every requirement. Raises ValueError for one without a lower bound."""
    out = {}
    for line in lines:
        found = re.fullmatch(r"([A-Za-z0-9._-]+)(?:\[.*\])?\s*(?:>=|==)\s*([0-9][\w.]*)\s*(?:[,;].*)?", line)
        if found is None:
            raise ValueError(f"{line!r} has no lower bound")
        out[found[1].lower()] = f"{found[1]}=={found[2]}"
    return sorted(out.values())


if __name__ == "__main__":
    words = sys.argv[1:]
    print("\n".join(pins(build_requirements() if words == ["--build"] else requirements(words))))
