"""The version of the program that numbers come from: its name, and a digest of the code that determines them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import stickslip
from stickslip.sim.kernels.digest import is_compiled
from stickslip.version import __version__

#: Packages and modules that determine numbers: a system and its run, which draws and settings a member has, what is
#: kept of its run, and how.
_DETERMINING = (
    "sim",
    "pipeline/dataset/schema.py",
    "pipeline/design/column.py",
    "pipeline/design/design.py",
    "pipeline/design/values.py",
    "pipeline/ensemble",
    "pipeline/own",
    "pipeline/records",
    "pipeline/running/ends.py",
    "pipeline/running/taken_over.py",
    "pipeline/running/worker.py",
    "pipeline/scene",
)

#: What no run needs of these.
_OUTSIDE = ("sim/runs/show.py",)


def program() -> str:
    """What numbers come from: the version of stickslip, and a digest of its code, as this process loaded it.

    Where kernels are not compiled, it says so.
    """
    return version_of(_DETERMINING) + ("" if is_compiled() else "-not-compiled")


@cache
def version_of(places: tuple[str, ...]) -> str:
    """The version of stickslip, and a digest of the code in packages and modules, as this process loaded it."""
    root = Path(stickslip.__file__).parent
    digest = hashlib.sha256()
    for name, file in sorted(_sources(root, places)):
        digest.update(f"{name} {hashlib.sha256(file.read_bytes()).hexdigest()}".encode())
    return f"{__version__}-{digest.hexdigest()[:16]}"


def _sources(root: Path, places: Iterable[str]) -> Iterator[tuple[str, Path]]:
    """The files of packages and modules, with their names below `root`."""
    for place in places:
        for file in [root / place] if place.endswith(".py") else (root / place).rglob("*.*"):
            name = file.relative_to(root).as_posix()
            if file.suffix in (".py", ".html", ".css") and not name.startswith(_OUTSIDE):
                yield name, file
