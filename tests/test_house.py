"""The house itself: floors, and that the project speaks of itself alone."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_a_floor_imports_only_from_floors_below():
    """The contracts are in pyproject.toml, under importlinter."""
    done = subprocess.run(
        [sys.executable, "-c", "from importlinter.cli import lint_imports_command; lint_imports_command()"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout


def test_the_physics_needs_no_dask_and_no_files():
    code = "import sys, sim; sys.exit(', '.join({'dask', 'pandas', 'pyarrow', 'matplotlib'} & set(sys.modules)) or 0)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
