"""The native library: one shared object for each set of vector instructions, plain C functions, for every Python.

The metadata is in ``setup.cfg``. ``LABSURVEY_NATIVE=checked`` builds with sanitizers and checked indices instead.
"""

import os
import sys
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

sys.path.insert(0, str(Path(__file__).parent / "build_tools"))
from native import MAC, CompilerError, NativeBuild, instruction_sets, machine


class Build(build_ext):
    """One compiler call for each source and set of instructions, side by side, and one link for each set."""

    def get_ext_filename(self, name):
        """The library's own name, without that of a Python."""
        return name.replace(".", "/") + ".so"

    def build_extensions(self):
        """Compile and link what is not kept from an earlier build."""
        libraries = {e.name.rpartition("_")[2]: Path(self.get_ext_fullpath(e.name)) for e in self.extensions}
        try:
            NativeBuild(os.environ.get("LABSURVEY_NATIVE") == "checked").run(libraries)
        except CompilerError as error:
            sys.exit(f"\nerror: {error}")


class Wheel(bdist_wheel):
    """A wheel for a platform, not for a Python."""

    def get_tag(self):
        """Any Python 3, no interface of it, this platform; of a Mac's Python for two processors only the one."""
        platform = super().get_tag()[2]
        return "py3", "none", platform.replace("universal2", machine()) if MAC else platform


setup(
    ext_modules=[Extension(f"adjust.native.kernels_{name}", []) for name in instruction_sets()],
    cmdclass={"build_ext": Build, "bdist_wheel": Wheel},
)
