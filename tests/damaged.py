"""Files of systems, and what can be done to them: damage of every kind, and what came of reading what is left."""

from __future__ import annotations

import contextlib
import io
import os
import resource
import signal
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import scipy.sparse

from stickslip.pipeline import SceneError, expand, load_scene
from stickslip.workflows.commands import main
from tests.scenes import ENDING

#: Seconds and bytes, beyond what it has, that a process may take for a file.
SECONDS, MEMORY = 30, 2**30

SCENE = """\
[system]
coupling = "file"
path = "{name}"
n = {n}
{damping}
[start]
z = 0.5
w = 0.0
[run]
t_end = 5.0
matrices = 1
"""


class File:
    """A file of a system: its name, its bytes, and, of an .npz, its arrays."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.n = n = int(rng.integers(2, 9))
        k = np.where(rng.random((n, n)) < 0.5, rng.integers(-9, 10, (n, n)), 0) + np.diag(rng.uniform(1.0, 2.0, n))
        self.k = k + k.T if rng.random() < 0.3 else k
        self.arrays: dict[str, Any] = {}
        form = rng.choice(["npy", "npz", "sparse", "mtx"])
        self.name = f"K.{'npz' if form == 'sparse' else form}"
        stream = io.BytesIO()
        if form == "npy":
            np.save(stream, np.asarray(self.k, order=rng.choice(["C", "F"]), dtype=rng.choice(["<f8", ">f8"])))
        if form == "mtx":
            scipy.io.mmwrite(stream, self.k if rng.random() < 0.3 else scipy.sparse.coo_array(self.k), precision=17)
        if form == "npz":
            self.arrays = {"stiffness": self.k, "friction": rng.uniform(0.8, 1.2, n), "damping": np.zeros(n)}
        if form == "sparse":
            kind = scipy.sparse.csc_array if rng.random() < 0.5 else scipy.sparse.csr_array
            scipy.sparse.save_npz(stream, kind(self.k))
            self.arrays = dict(np.load(io.BytesIO(stream.getvalue())))
        self.content = self.packed(rng) if self.arrays else stream.getvalue()

    def packed(self, rng: np.random.Generator) -> bytes:
        stream = io.BytesIO()
        (np.savez if rng.random() < 0.5 else np.savez_compressed)(stream, **self.arrays)
        return stream.getvalue()


def _bit(file: File, rng: np.random.Generator, n_bits: int = 1) -> bytes:
    content = bytearray(file.content)
    for at in rng.integers(0, len(content), n_bits):
        content[at] ^= 1 << int(rng.integers(8))
    return bytes(content)


def _header(file: File, rng: np.random.Generator) -> bytes:
    """A bit where the structure is: the head of the file, of a member, or the directory of a zip file."""
    content = bytearray(file.content)
    starts = [at for magic in (b"PK", b"\x93NUMPY") for at in _all(file.content, magic)] or [0]
    at = min(int(rng.choice(starts) + rng.integers(120)), len(content) - 1)
    content[at] ^= 1 << int(rng.integers(8))
    return bytes(content)


def _all(content: bytes, part: bytes) -> list[int]:
    return [at for at in range(len(content)) if content.startswith(part, at)]


def _zeroed(file: File, rng: np.random.Generator) -> bytes:
    start, length = int(rng.integers(len(file.content))), int(rng.integers(1, 64))
    return file.content[:start] + bytes(length) + file.content[start + length :]


def _index(file: File, rng: np.random.Generator) -> bytes:
    """A whole .npz, or text, in which an index, a bound of a row or a size is another number."""
    number = int(rng.choice([-5, -1, 0, 1, 2, 3, file.n, file.n + 1, 1000, 2**31 - 1, -(2**31), 10**12, 2**62]))
    if file.arrays.keys() >= {"indices"}:
        key = str(rng.choice(["indices", "indptr", "shape"]))
        changed = file.arrays[key].astype(np.int64 if abs(number) >= 2**31 else file.arrays[key].dtype)
        changed[rng.integers(changed.size)] = number
        file.arrays[key] = changed
        return file.packed(rng)
    lines = file.content.split(b"\n")
    where = int(rng.integers(1, len(lines)))
    words = lines[where].split(b" ")
    words[rng.integers(len(words))] = str(number).encode()
    return b"\n".join([*lines[:where], b" ".join(words), *lines[where + 1 :]])


def _members(file: File, rng: np.random.Generator) -> bytes:
    """Members swapped, left out or doubled."""
    keys = rng.permutation(list(file.arrays) or ["a", "b"])
    what = rng.choice(["swap", "drop", "double", "more"])
    if what == "swap" and file.arrays:
        a, b = keys[:2]
        file.arrays[a], file.arrays[b] = file.arrays[b], file.arrays[a]
    elif what == "drop":
        file.arrays.pop(keys[0], None)
    content = file.packed(rng)
    if what in ("double", "more"):
        stream = io.BytesIO(content)
        with warnings.catch_warnings(action="ignore"), zipfile.ZipFile(stream, "a") as archive:
            archive.writestr(f"{keys[0]}.npy" if what == "double" else "\x1b[2J.npy", b"\x93NUMPY")
        content = stream.getvalue()
    return content


def _kind(file: File, rng: np.random.Generator) -> bytes:
    kinds = ["f2", "f4", ">f8", "g", "c16", "?", "i1", "u8", "U9", "S9", "O", "M8[s]", "m8[s]", "f8,f8", "V8"]
    kind = str(rng.choice(kinds))
    arrays = file.arrays or {"stiffness": file.k}
    key = str(rng.choice([key for key in arrays if key not in ("format", "_is_array")]))
    with contextlib.suppress(TypeError, ValueError), warnings.catch_warnings(action="ignore"):
        arrays[key] = np.asarray(arrays[key]).astype(kind)
    file.arrays = arrays
    return file.packed(rng)


def _value(file: File, rng: np.random.Generator) -> bytes:
    arrays = file.arrays or {"stiffness": file.k}
    key = "data" if "data" in arrays else str(rng.choice(list(arrays)))
    arrays[key] = arrays[key].astype(float)
    arrays[key].flat[rng.integers(arrays[key].size)] = rng.choice([np.nan, np.inf, -np.inf, -1.0])
    file.arrays = arrays
    return file.packed(rng)


def _shape(file: File, rng: np.random.Generator) -> bytes:
    arrays = file.arrays or {"stiffness": file.k}
    key = str(rng.choice([key for key in arrays if key not in ("format", "_is_array")]))
    array = arrays[key]
    arrays[key] = [array[:-1], array[None], array.ravel(), array[:0], array.flat[0], np.append(array, array)][
        rng.integers(6)
    ]
    file.arrays = arrays
    return file.packed(rng)


def _claims(file: File, rng: np.random.Generator) -> bytes:
    """Sizes far beyond what is there: in the header of an array, the directory of a zip file, a line of text."""
    big = int(10 ** rng.uniform(4, 17))
    if rng.random() < 0.3:
        return b"%%%%MatrixMarket matrix coordinate real general\n%d %d %d\n1 1 1.0\n" % tuple(rng.permutation(
            [big, big, 1]))  # fmt: skip
    head = b"{'descr': '<f8', 'fortran_order': False, 'shape': (%d, %d), }\n" % (big, rng.choice([0, 1, big]))
    array = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head
    if rng.random() < 0.4:
        return array
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("stiffness.npy", array + bytes(10**6))
    content = bytearray(stream.getvalue())
    at = _all(content, b"PK\x01\x02")[0]
    content[at + 24 : at + 28] = min(big, 2**32 - 2).to_bytes(4, "little")
    return bytes(content)


def _encrypted(file: File, rng: np.random.Generator) -> bytes:
    content = bytearray(file.content if file.arrays else File.packed(file, rng))
    for magic, place in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        for at in _all(bytes(content), magic):
            content[at + place] |= 1
    return bytes(content)


def _comment(file: File, rng: np.random.Generator) -> bytes:
    comment = rng.bytes(int(rng.integers(1, 200)))
    if file.name == "K.mtx":
        return file.content.replace(b"\n", b"\n%" + comment + b"\n", 1)
    return file.content + comment if rng.random() < 0.5 else comment + file.content


def _text(file: File, rng: np.random.Generator) -> bytes:
    """A line of text removed, doubled or spoilt."""
    lines = file.content.split(b"\n")
    at = int(rng.integers(len(lines)))
    spoilt = [b"", lines[at] + b" 1", b"1 1 nan", b"1 1 1e999", b"1 1 0x1p4", b"1 1 1 1", b"\x00" * 9, b"9" * 5000,
              b"1 1 1_0", "１ 1 1".encode(), lines[at] + b"\r", b"%", lines[at] + b"\n" + lines[at]]  # fmt: skip
    return b"\n".join([*lines[:at], spoilt[rng.integers(len(spoilt))], *lines[at + 1 :]])


#: What is done to the bytes.
DAMAGE: dict[str, Callable[[File, np.random.Generator], bytes]] = {
    "a bit": _bit,
    "some bits": lambda file, rng: _bit(file, rng, int(rng.integers(2, 30))),
    "a bit of a header": _header,
    "zeros": _zeroed,
    "cut off": lambda file, rng: file.content[: int(rng.integers(len(file.content)))],
    "an index": _index,
    "members": _members,
    "type": _kind,
    "value": _value,
    "shape": _shape,
    "claims": _claims,
    "encrypted": _encrypted,
    "comment": _comment,
    "line of text": _text,
    "garbage": lambda file, rng: file.content[: int(rng.integers(2, 60))] + rng.bytes(int(rng.integers(300))),
    "empty": lambda file, rng: b"",
}
#: Of these the sum that an .npz has for each member leaves nothing that could be read as another matrix.
CHECKED = ("a bit", "some bits", "a bit of a header", "zeros", "cut off", "encrypted", "empty")

#: What is put in the file's place.
NO_FILES: dict[str, Callable[[Path], None]] = {
    "directory": lambda path: path.mkdir(),
    "pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "circle of links": lambda path: path.symlink_to(path),
    "dangling link": lambda path: path.symlink_to("nowhere"),
}


def independent(content: bytes) -> Any:
    """K as a reader reads it that has nothing of ours."""
    if content.startswith(b"%%"):
        return _entries(content.decode("latin1"))
    found = np.load(io.BytesIO(content))
    if isinstance(found, np.ndarray):
        return found
    if "stiffness" in found.files or "data" not in found.files:
        return found["stiffness" if "stiffness" in found.files else found.files[0]]
    matrix = np.zeros(found["shape"])
    for line, (start, end) in enumerate(zip(found["indptr"], found["indptr"][1:], strict=False)):
        for index, value in zip(found["indices"][start:end], found["data"][start:end], strict=True):
            matrix[(index, line) if found["format"].item() == b"csc" else (line, index)] += value
    return matrix


def _entries(text: str) -> np.ndarray:
    first, *rest = text.split("\n")
    *_, layout, _, symmetry = first.lower().split()
    (rows, columns, *_), *entries = [line.split() for line in rest if line.strip() and not line.startswith("%")]
    matrix = np.zeros((int(rows), int(columns)))
    if layout == "array":
        places = [(i, j) for j in range(int(columns)) for i in range(j if symmetry == "symmetric" else 0, int(rows))]
        entries = [[i + 1, j + 1, entry[0]] for (i, j), entry in zip(places, entries, strict=True)]
    for i, j, value in entries:
        matrix[int(i) - 1, int(j) - 1] += float(value)
        if symmetry == "symmetric" and i != j:
            matrix[int(j) - 1, int(i) - 1] += float(value)
    return matrix


def damage(seed: int, number: int, folder: Path) -> tuple[str, File]:
    """Write a damaged file and its scene; what was done, and the file before."""
    rng = np.random.default_rng([seed, number])
    file = File(rng)
    before = File(np.random.default_rng([seed, number]))
    path = folder / file.name
    kind = [*DAMAGE, *NO_FILES][number % len(DAMAGE | NO_FILES)]
    if kind in NO_FILES:
        NO_FILES[kind](path)
    else:
        path.write_bytes(DAMAGE[kind](file, rng))
    (folder / "mine.toml").write_text(
        SCENE.format(name=file.name, n=file.n, damping="" if "damping" in file.arrays else "rho = 3.5") + ENDING
    )
    return kind, before


def judge(case: tuple[int, int, str]) -> str:
    """What came of the damaged file of a case: "refused", "as it was" or "another", read right; or AssertionError."""
    seed, number, at = case
    folder = Path(at)
    signal.alarm(SECONDS)
    limit = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
    kind, before = damage(seed, number, folder)
    try:
        scene = load_scene(folder / "mine.toml")
    except SceneError:
        with contextlib.redirect_stderr(io.StringIO()) as told:
            assert main(["run", str(folder / "mine.toml"), "--out", str(folder / "out")]) == 2, kind
        line = told.getvalue().removesuffix("\n")
        assert line.isprintable(), f"{kind}: {line!r}"
        assert not (folder / "out").exists(), kind
        return "refused"
    found = expand(scene)[0].system().stiffness
    found = found.toarray() if scipy.sparse.issparse(found) else found
    if np.array_equal(found, before.k):
        return "as it was"
    assert not (before.arrays and kind in CHECKED), f"{kind}: not what its sum is of"
    expected = independent((folder / before.name).read_bytes())
    assert np.array_equal(found, np.asarray(expected, dtype=np.float64)), f"{kind}: {found} in place of {expected}"
    return "another"
