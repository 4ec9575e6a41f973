"""SciPy's compiled special functions without the Python around them, which takes longer to load than a small survey.

``ufuncs`` is ``scipy.special`` where that is loaded already, or where SciPy is built in another way than expected.
"""

import importlib
import sys
from pathlib import Path
from types import ModuleType

import scipy

__all__ = ["ufuncs"]

_PACKAGE = "scipy.special"
_NEEDED = ("gammainc", "gammaincc", "gammaincinv", "gammainccinv", "chndtr", "chndtrix", "ndtr", "ndtri", "stdtr",
           "stdtrit", "fdtrc", "fdtri", "betaincinv")  # fmt: skip


def _compiled() -> ModuleType | None:
    """The module of functions, loaded under a package of its own that is gone afterwards; None where it has others."""
    package = ModuleType(_PACKAGE)
    package.__path__ = [str(Path(scipy.__file__).parent / "special")]
    sys.modules[_PACKAGE] = package
    try:
        found = importlib.import_module(f"{_PACKAGE}._ufuncs")
    except ImportError:
        return None
    finally:
        del sys.modules[_PACKAGE]
    return found if all(hasattr(found, name) for name in _NEEDED) else None


ufuncs = sys.modules.get(_PACKAGE) or _compiled() or importlib.import_module(_PACKAGE)
