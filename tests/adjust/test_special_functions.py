"""SciPy's functions without its package are SciPy's functions, and the package loads afterwards as ever."""

import subprocess
import sys

CODE = """
import sys
from adjust.special_functions import _NEEDED, ufuncs
print("scipy.special" in sys.modules, "scipy.linalg" in sys.modules)
import scipy.special, scipy.stats
print(all(getattr(scipy.special, name) is getattr(ufuncs, name) for name in _NEEDED))
print(scipy.stats.chi2.ppf(0.5, 3) == 2 * ufuncs.gammaincinv(1.5, 0.5))
"""
OTHER = """
import sys, scipy.special
from adjust.special_functions import ufuncs
print(ufuncs is scipy.special)
"""


def test_before_the_package():
    run = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True, timeout=60)
    assert run.stdout.split() == ["False", "False", "True", "True"]


def test_after_the_package():
    run = subprocess.run([sys.executable, "-c", OTHER], capture_output=True, text=True, check=True, timeout=60)
    assert run.stdout.split() == ["True"]
