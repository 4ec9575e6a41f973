"""Kernels: nothing is loaded before one is called, one machine code for all constants, no stale machine code."""

import os
import pickle
import subprocess
import sys
import textwrap

import numpy as np

from adjust.compiling import made_of
from adjust.navigation.search_kernels import search
from adjust.tree_kernels import _times, offset_in


def run(code, folder, **environment):
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=300, check=True,
        cwd=folder, env=os.environ | environment | {"PYTHONPATH": os.pathsep.join([str(folder), *sys.path])},
    ).stdout.split()  # fmt: skip


def test_modules_of_kernels_load_without_numba(tmp_path):
    code = "import sys, adjust.graph, adjust.statistics.cleaned, survey.rendering; print('numba' in sys.modules)"
    assert run(code, tmp_path) == ["False"]


def test_a_kernel_is_pickled_by_its_name():
    assert pickle.loads(pickle.dumps(search)) is search


def test_constants_share_one_machine_code(tmp_path):
    (tmp_path / "inner.py").write_text(textwrap.dedent("""
        from adjust.compiling import njit

        @njit(cache=True)
        def shifted(x, by, twice):
            return x + 2 * by if twice else x + by
    """))
    (tmp_path / "outer.py").write_text(textwrap.dedent("""
        from adjust.compiling import njit
        from inner import shifted

        @njit(cache=True)
        def both(x, by):
            return shifted(x, 1, True) + shifted(x, 2, False) + shifted(x, by, by > 3)
    """))
    code = "from inner import shifted; from outer import both; print(both(10, 5), len(shifted.signatures))"
    assert run(code, tmp_path) == [str(12 + 12 + 20), "1"]


def test_another_file_or_constant_makes_new_machine_code(tmp_path):
    inner, outer = tmp_path / "inner.py", tmp_path / "outer.py"
    outer.write_text(textwrap.dedent("""
        from adjust.compiling import njit
        from inner import FACTOR, plus

        @njit(cache=True)
        def both(x):
            return FACTOR * plus(x)
    """))

    def write(factor, term):
        inner.write_text(textwrap.dedent(f"""
            from adjust.compiling import njit

            FACTOR = {factor}

            @njit(cache=True)
            def plus(x):
                return x + {term}
        """))

    code = "from outer import both; print(both(1), sum(both.stats.cache_hits.values()))"
    write(10, 1)
    assert run(code, tmp_path, PYTHONDONTWRITEBYTECODE="1") == ["20", "0"]
    assert run(code, tmp_path, PYTHONDONTWRITEBYTECODE="1") == ["20", "1"]
    write(10, 200)  # the file of the kernel itself stays as it is
    assert run(code, tmp_path, PYTHONDONTWRITEBYTECODE="1") == ["2010", "0"]
    write(1000, 200)
    assert run(code, tmp_path, PYTHONDONTWRITEBYTECODE="1") == ["201000", "0"]


def test_what_a_kernel_is_made_of():
    files, _ = made_of(search.py_func)
    assert [name for name, _ in files] == ["adjust.navigation.minimal_kernels", "adjust.navigation.search_kernels"]
    _, constants = made_of(_times.py_func)
    assert dict(constants) == {"adjust.tree_kernels._BY_HAND": "120000"}
    assert made_of(offset_in.py_func)[1] == ()


def test_products_by_hand_and_by_blas_agree():
    rng = np.random.default_rng(2)
    for n, m, inner in ((1, 1, 1), (3, 6, 2), (40, 50, 50), (60, 50, 50)):
        A, B, wide = rng.normal(size=(n, inner)), rng.normal(size=(inner, m)), np.full((n, m + 2), 7.0)
        _times(A, B, wide)
        np.testing.assert_allclose(wide[:, :m], A @ B, atol=1e-12)
        assert (wide[:, m:] == 7.0).all()
