"""The house itself: floors, and that the project speaks of itself alone."""

import tomllib
from pathlib import Path

from tests.processes import python

ROOT = Path(__file__).parents[1]


def test_a_floor_imports_only_from_floors_below():
    """The contracts are in pyproject.toml, under importlinter."""
    done = python("-c", "from importlinter.cli import lint_imports_command; lint_imports_command()", cwd=ROOT)
    assert done.returncode == 0, done.stdout


def test_the_physics_needs_no_dask_and_no_files():
    assert not {"dask", "pandas", "pyarrow", "matplotlib"} & loaded_by("from stickslip import sim, simulate")


def test_the_name_loads_nothing():
    """`import stickslip` takes some hundredths of a second; numba alone would take half of one."""
    assert not {"numpy", "numba", "scipy", "pandas", "dask"} & loaded_by("import stickslip; stickslip.__version__")


def test_another_system_is_refused_in_a_line_when_it_is_imported():
    """As Windows calls itself; before anything is loaded that is not there."""
    show = "import os; os.name = 'nt'; import stickslip"
    done = python("-c", show, cwd=ROOT)
    line = done.stderr.splitlines()[-1]
    assert line.startswith("ImportError: stickslip runs on Linux and macOS, not on 'nt'")
    assert "WSL" in line


def test_what_lies_beside_the_modules_is_in_a_wheel():
    """Templates, their style and the scenes; guides lie there for readers of the repository."""
    named = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    kept = {
        file.resolve()
        for package, patterns in named.items()
        if package != "*"
        for pattern in patterns
        for file in (ROOT / package.replace(".", "/")).glob(pattern)
    }
    beside = {
        file.resolve()
        for floor in ("sim", "pipeline", "analysis", "workflows")
        for file in (ROOT / floor).rglob("*")
        if file.suffix in (".html", ".css", ".toml")
    }
    assert beside
    assert beside <= kept


def loaded_by(code):
    show = f"{code}; import sys; print(*sys.modules)"
    done = python("-c", show, cwd=ROOT, check=True)
    return set(done.stdout.split())


def test_a_run_from_kept_kernels_loads_nothing_to_compile_with():
    """Nor parts of SciPy, as K is dense: to load all that takes longer than many a run."""
    run = (
        "from stickslip import draw_system, simulate; system = draw_system('antisymmetric', n=3, seed=0); "
        "[simulate(system, 0.0, 0.0, t_end=1.0, engine=engine) for engine in ('coulomb', 'sigmoid')]"
    )
    loaded_by(run)  # compiled, if they are not kept yet
    loaded = loaded_by(run)
    assert "numba" in loaded
    assert not loaded & {"scipy.sparse", "scipy.linalg", "pandas", "numba.np.linalg", "numba.np.arraymath"}
