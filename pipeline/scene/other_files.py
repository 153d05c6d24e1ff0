"""Files of K that other programs write: told by their content, with the line of Python that makes a system file."""

from __future__ import annotations

import io
import re
import zipfile
from typing import NamedTuple

_HDF5 = b"\x89HDF\r\n\x1a\n"
_DENSE = 'numpy.savez("K.npz", stiffness={})'
_ANY = 'scipy.io.mmwrite("K.mtx", {})'
_SHEET = _DENSE.format("pandas.read_excel({file}, header=None).to_numpy(float)")
_GRAPH = f"G = {{}}; {_ANY.format('networkx.laplacian_matrix(G, sorted(G){})')}"

#: So many bytes tell what a text holds.
_HEAD = 100_000


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
    b"MATLAB 7.3": Kind(
        "a MATLAB file of version 7.3, which is HDF5: in MATLAB save it with -v7",
        _DENSE.format('h5py.File({file})["K"][...].T'),
    ),
    _HDF5: Kind("an HDF5 file", _DENSE.format('h5py.File({file})["K"][...]')),
    b"CDF": Kind("a NetCDF file", _DENSE.format('scipy.io.netcdf_file({file}, mmap=False).variables["K"][...]')),
    b"PAR1": Kind("a Parquet file", _DENSE.format("pandas.read_parquet({file}).to_numpy(float)")),
    b"ARROW1": Kind("an Arrow file", _DENSE.format("pandas.read_feather({file}).to_numpy(float)")),
    b"\xd0\xcf\x11\xe0": Kind("an Excel file", _SHEET),
    b"\x80": Kind(
        "a pickle, which is code: convert only one that you trust", _ANY.format('pickle.load(open({file}, "rb"))')
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
    return None


def _of_archive(content: bytes) -> Kind | None:
    """A workbook, which is a ZIP archive as an .npz is."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        names = archive.namelist()
    if "xl/workbook.xml" in names or "content.xml" in names:
        return Kind("a workbook", _SHEET)
    return None
