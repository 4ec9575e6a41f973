"""setuptools' build backend; where no able C++ compiler is found, it asks for one that the package index has."""

import os
import shlex
import shutil
import subprocess
import sysconfig
from functools import cache
from typing import Any

from setuptools import build_meta
from setuptools.build_meta import (  # the hooks that stay setuptools' own
    build_editable,
    build_sdist,
    build_wheel,
    get_requires_for_build_sdist,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)

__all__ = [
    "build_editable", "build_sdist", "build_wheel", "compiler", "get_requires_for_build_editable",
    "get_requires_for_build_sdist", "get_requires_for_build_wheel", "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]  # fmt: skip

_NEEDED = b"""
#include <bit>
#include <cmath>
template <class T> concept Any = true;
auto f = []<Any T>(T x) { return x; };
"""


@cache
def compiler() -> list[str] | None:
    """The C++ compiler of this machine as the beginning of a command, None where there is none for C++20.

    What ``CXX`` names is taken as it is.
    """
    named = shlex.split(os.environ.get("CXX") or "")
    if named:
        return named
    configured = shlex.split(sysconfig.get_config_var("CXX") or "")[:1]
    names = dict.fromkeys([*configured, "c++", "g++", "clang++"])
    return next(([name] for name in names if shutil.which(name) and _able(name)), None)


def _able(name: str) -> bool:
    command = [name, "-std=c++20", "-x", "c++", "-fsyntax-only", "-"]
    return subprocess.run(command, input=_NEEDED, capture_output=True, check=False).returncode == 0


def _more() -> list[str]:
    return [] if compiler() else ["ziglang>=0.13"]


def get_requires_for_build_wheel(config_settings: Any = None) -> list[str]:
    """What setuptools needs, and a compiler."""
    return [*build_meta.get_requires_for_build_wheel(config_settings), *_more()]


def get_requires_for_build_editable(config_settings: Any = None) -> list[str]:
    """What setuptools needs, and a compiler."""
    return [*build_meta.get_requires_for_build_editable(config_settings), *_more()]
