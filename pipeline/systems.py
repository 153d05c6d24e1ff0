"""Systems from files: K, and what else a file holds, read once, checked, and known by a digest from then on."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import scipy.sparse

from stickslip.pipeline.errors import SceneError
from stickslip.sim.arguments import per_block
from stickslip.sim.system import System

#: What a file may hold beside `stiffness`, one number a block each.
BY_BLOCK = ("damping", "friction", "z0", "w0")

#: The parts of a sparse matrix as `scipy.sparse.save_npz` names them.
_SPARSE = {"data", "indices", "indptr", "shape", "format"}

_EXPECTED = "an array `stiffness`, or a sparse K as scipy.sparse.save_npz writes it, and of " + ", ".join(BY_BLOCK)


@dataclass(frozen=True, slots=True)
class SystemFile:
    """A file that a system is read from: its name beside the scene, the sha256 of its bytes, and where it lies."""

    name: str
    sha256: str
    at: str = field(compare=False)
    scale: float
    entries: int
    is_sparse: bool
    arrays: tuple[str, ...]

    def matrix(self, draw: int) -> int:
        """The number of a draw of what the file leaves open: of its content, so that other files move nothing."""
        return int(hashlib.sha256(f"{self.sha256} {draw}".encode()).hexdigest()[:7], 16)


def read(file: SystemFile) -> Mapping[str, Any]:
    """What a file holds, by name.

    Raises
    ------
    SceneError
        If it is gone, or not what it was.
    """
    return _read(file.at, file.sha256)


@lru_cache(maxsize=2)
def _read(at: str, sha256: str) -> Mapping[str, Any]:
    content = _content(Path(at))
    digest = hashlib.sha256(content).hexdigest()
    if digest != sha256:
        raise SceneError(
            f"system.path: expected {at} as it was when the scene was read (sha256 {sha256[:12]}), got another "
            f"(sha256 {digest[:12]}); restore the file, or run the scene with it into another directory"
        )
    return _arrays(at, content)


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise SceneError(
            f"system.path: {path} cannot be read ({error.strerror}); restore it, or correct the path"
        ) from None


def _arrays(name: str, content: bytes) -> dict[str, Any]:
    stream = io.BytesIO(content)
    try:
        if name.endswith((".mtx", ".mtx.gz")):
            return {"stiffness": scipy.io.mmread(stream)}
        found = np.load(stream, allow_pickle=False)
        if isinstance(found, np.ndarray):
            return {"stiffness": found}
        arrays = {key: found[key] for key in found.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        why = " ".join(str(error).split())
        raise SceneError(f"system.path: {name}: expected an .npz, .npy or Matrix Market file, got: {why}") from None
    if arrays.keys() >= _SPARSE:
        parts = {key: arrays.pop(key) for key in _SPARSE}
        arrays.pop("_is_array", None)
        kind = {b"csc": scipy.sparse.csc_array, b"csr": scipy.sparse.csr_array}.get(bytes(parts["format"].item()))
        if kind is None:
            raise SceneError(f"system.path: {name}: expected the format csc or csr, got {parts['format'].item()!r}")
        arrays["stiffness"] = kind((parts["data"], parts["indices"], parts["indptr"]), parts["shape"])
    elif "stiffness" not in arrays and len(arrays) == 1:
        arrays = {"stiffness": next(iter(arrays.values()))}
    unknown = sorted(arrays.keys() - {"stiffness", *BY_BLOCK})
    if unknown or "stiffness" not in arrays:
        raise SceneError(f"system.path: {name}: expected {_EXPECTED}, got {', '.join(sorted(arrays)) or 'nothing'}")
    return arrays


def _checked(name: str, content: bytes) -> dict[str, Any]:
    """What a scene says of a file once it is read, as plain values."""
    arrays = _arrays(name, content)
    try:
        system = System(arrays["stiffness"], arrays.get("damping", 0.0), arrays.get("friction", 1.0))
        for key in ("z0", "w0"):
            per_block(key, arrays.get(key, 0.0), system.n)
    except (TypeError, ValueError) as error:
        why = " ".join(str(error).split())  # it may show an array
        raise SceneError(f"system.path: {name}: {why if len(why) < 300 else f'{why[:297]}...'}") from None
    return {
        "sha256": hashlib.sha256(content).hexdigest(),
        "n": system.n,
        "scale": float(abs(system.stiffness).max()),
        "entries": system.stiffness.size,
        "is_sparse": not isinstance(system.stiffness, np.ndarray),
        "arrays": [key for key in BY_BLOCK if key in arrays],
    }


def with_files(tables: Mapping[str, Any], source: bytes, folder: Path) -> bytes:
    """The source of a scene with a table of the files that its systems are read from, as they are now.

    From then on the scene is known from its source alone, and a file that changes is another scene.

    Raises
    ------
    SceneError
        If there is no such file, or it holds no system.
    """
    system = tables.get("system")
    if not isinstance(system, dict) or system.get("coupling") != "file" or "files" in system:
        return source
    pattern = system.get("path")
    if not isinstance(pattern, str):
        return source  # which is refused when it is read
    base = Path(pattern)
    found = [folder / base] if (folder / base).is_file() else _glob(folder, pattern)
    if not found:
        raise SceneError(f"system.path: expected a file, or several by a pattern such as K*.npz, got {pattern!r}, "
                         f"which names none in {folder.resolve()}; correct the path")  # fmt: skip
    lines = ["", "# What the files were when this scene was read; written by stickslip.", "[system.files]"]
    for file in found:
        at = file.resolve()
        name = at.relative_to(folder.resolve()).as_posix() if at.is_relative_to(folder.resolve()) else at.name
        about = {"at": str(at), **_checked(str(file), _content(file))}
        written = ", ".join(f"{key} = {json.dumps(value)}" for key, value in about.items())
        lines.append(f"{json.dumps(name)} = {{{written}}}")
    return source.rstrip() + ("\n".join(lines) + "\n").encode()


def _glob(folder: Path, pattern: str) -> list[Path]:
    base = Path(pattern)
    root, rest = (Path(base.anchor), pattern[len(base.anchor) :]) if base.is_absolute() else (folder, pattern)
    return sorted(file for file in root.glob(rest) if file.is_file()) if rest else []
