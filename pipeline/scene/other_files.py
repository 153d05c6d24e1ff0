"""Files of K that other programs write: told by their content, with the line of Python that makes a system file."""

from __future__ import annotations

import io
import re
import zipfile
from functools import partial
from typing import NamedTuple

from stickslip.pipeline.scene.toml import MAX_BLOCKS

_HDF5 = b"\x89HDF\r\n\x1a\n"
_DENSE = 'numpy.savez("K.npz", stiffness={})'
_ANY = 'scipy.io.mmwrite("K.mtx", {})'
_SHEET = _DENSE.format("pandas.read_excel({file}, header=None).to_numpy(float)")
_GRAPH = f"G = {{}}; {_ANY.format('networkx.laplacian_matrix(G, sorted(G){})')}"

#: So many bytes, and lines, tell what a text holds.
_HEAD, _LINES = 100_000, 1000
#: Characters of a row of numbers: of most blocks, all digits of each.
_LONGEST = 30 * MAX_BLOCKS


class Kind(NamedTuple):
    """What a file is, and Python that converts it, where {file} stands for its name in quotes."""

    name: str
    line: str
    is_graph: bool = False  #: whether `coupling = "graph"` reads it


class OtherKind(ValueError):
    """A file is of a kind that K can be brought from, and that is not read itself."""

    def __init__(self, kind: Kind) -> None:
        super().__init__(kind.name)
        self.kind = kind

    def line(self, file: str) -> str:
        """Python that writes K.npz or K.mtx from a file."""
        quoted = '"' + file.replace("\\", "\\\\").replace('"', '\\"') + '"'
        return self.kind.line.replace("{file}", quoted)


#: By the bytes at its beginning.
_BY_MAGIC = {
    b"MATLAB 5": Kind("a MATLAB file", _ANY.format('scipy.io.loadmat({file})["K"]')),
    b"MATLAB 7.3": Kind("a MATLAB file, version 7.3", _DENSE.format('h5py.File({file})["K"][...].T')),
    _HDF5: Kind("an HDF5 file", _DENSE.format('h5py.File({file})["K"][...]')),
    b"CDF": Kind("a NetCDF file", _DENSE.format('scipy.io.netcdf_file({file}, mmap=False).variables["K"][...]')),
    b"PAR1": Kind("a Parquet file", _DENSE.format("pandas.read_parquet({file}).to_numpy(float)")),
    b"ARROW1": Kind("an Arrow file", _DENSE.format("pandas.read_feather({file}).to_numpy(float)")),
    b"\xd0\xcf\x11\xe0": Kind("an Excel file", _SHEET),
    b"\x80": Kind(
        "a pickle, which is code: convert only one that you trust",
        _ANY.format('pickle.load(open({file}, "rb"))'),
    ),
    b"\x1f\x8b": Kind("a file compressed by gzip", 'open("K", "wb").write(gzip.open({file}).read())'),
    b"BZh": Kind("a file compressed by bzip2", 'open("K", "wb").write(bz2.open({file}).read())'),
    b"\xfd7zXZ": Kind("a file compressed by xz", 'open("K", "wb").write(lzma.open({file}).read())'),
}

#: By a pattern of the first words of a text.
_BY_WORDS = {
    rb"<([^\0]*<)?graphml": Kind(
        "a text of GraphML", _GRAPH.format("networkx.read_graphml({file}).to_undirected()", ""), True
    ),
    rb"<([^\0]*<)?gexf": Kind("a text of GEXF", _GRAPH.format("networkx.Graph(networkx.read_gexf({file}))", "")),
    rb"[^\0]*?\bgraph\s*\[": Kind("a text of GML", _GRAPH.format("networkx.Graph(networkx.read_gml({file}))", "")),
    rb"\*[Vv]ertices": Kind("a text for Pajek", _GRAPH.format("networkx.Graph(networkx.read_pajek({file}))", "")),
    rb"\[\s*\[?\s*[-\d]|\{\s*\"": Kind("JSON", _DENSE.format("json.load(open({file}))")),
}


def kind_of(content: bytes) -> Kind | None:
    """The kind of a file that is no system file; None if it may be one, or nothing is known of it."""
    if content.startswith((b"%%MatrixMarket", b"\x93NUMPY")):
        return None
    if content.startswith(b"PK"):
        return _of_archive(content)
    for magic, kind in _BY_MAGIC.items():
        if content.startswith(magic):
            return kind
    if content[512:520] == _HDF5:
        return _BY_MAGIC[_HDF5]
    head = content[:_HEAD].removeprefix(b"\xef\xbb\xbf").lstrip()
    for pattern, kind in _BY_WORDS.items():
        if re.match(pattern, head):
            return kind
    return _of_text(content)


def _of_archive(content: bytes) -> Kind | None:
    """A workbook, which is a ZIP archive as an .npz is."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        names = archive.namelist()
    if "xl/workbook.xml" in names or "content.xml" in names:
        return Kind("a workbook", _SHEET)
    return None


def _of_text(content: bytes) -> Kind | None:
    """A table of numbers, or a list of edges with or without their weights."""
    encoding = {b"\xef\xbb": "utf-8-sig", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}.get(content[:2], "utf-8")
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError:
        return None
    rows = [row for row in text.splitlines() if row.strip() and not row.startswith(("#", "%"))]
    if not rows or "\0" in text:
        return None
    if max(map(len, rows[:_LINES])) > _LONGEST:
        return None
    comma = ";" in rows[-1] and "," in rows[-1]  # of decimals
    separator = next((mark for mark in (";", "\t", ",") if mark in rows[-1]), None)
    cells = [row.split(separator) for row in rows[:_LINES]]
    number = partial(_is_number, comma=comma)
    heads = 0 if all(map(number, cells[0])) else 1
    width = len(cells[-1])
    if cells[0] == [*map(str, range(width))] and len(rows) == width + 1:
        heads = 1  # as pandas numbers columns
    n_rows = len(rows) - heads
    names = 0 if separator is None else 2 if width == 3 else 1  # of blocks, before the numbers
    body = cells[heads:]
    if n_rows == 0 or any(len(row) != width or not all(map(number, row[names:])) for row in body):
        return None
    options = "" if heads else ", header=None"
    options += ", comment='#'" if len(rows) < len(text.splitlines()) else ""
    options += {None: ", sep=r'\\s+'", ",": ""}.get(separator, f", sep={separator!r}")
    options += ", decimal=','" if comma else ""
    options += "" if encoding == "utf-8" else f", encoding={encoding!r}"
    if width in (2, 3) and n_rows != width:
        ends = cells[0] if heads and len(cells[0]) == width else list(range(width))
        table = f"pandas.read_csv({{file}}{options}), {', '.join(repr(end) for end in ends)}"
        weight = f", weight={ends[2]!r}" if width == 3 else ""
        return Kind("a text that lists edges", _GRAPH.format(f"networkx.from_pandas_edgelist({table})", weight), True)
    options += ", index_col=0" if heads and width == n_rows + 1 else ""
    name = "a text of numbers" if separator is None else "a CSV file"
    return Kind(name, _DENSE.format(f"pandas.read_csv({{file}}{options}).to_numpy(float)"))


def _is_number(cell: str, comma: bool) -> bool:
    try:
        float(cell.replace(",", ".") if comma else cell)
    except ValueError:
        return False
    return True
