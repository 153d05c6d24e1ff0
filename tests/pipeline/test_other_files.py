"""Files of K that other programs write: each is named, and the line of Python that the message gives converts it."""

import bz2
import gzip
import io
import json
import lzma
import pickle
import zipfile

import networkx
import numpy as np
import pandas as pd
import pytest
import scipy.io
import scipy.sparse

from stickslip.pipeline import SceneError
from stickslip.pipeline.scene.systems import BY_BLOCK, arrays_of, look_at_files

K = np.array([[2.5, -1.0, 0.0, 0.25], [-1.0, 2.0, -1.0, 0.0], [0.0, -1.0, 2.0, -1.0], [0.25, 0.0, -1.0, 3.0]])
FRAME = pd.DataFrame(K)
#: The Laplacian of a path of three springs, of 1, 2 and 3.
PATH = np.array([[1.0, -1.0, 0.0, 0.0], [-1.0, 3.0, -2.0, 0.0], [0.0, -2.0, 5.0, -3.0], [0.0, 0.0, -3.0, 3.0]])
PAIRS = [[1, -1, 0, 0], [-1, 2, -1, 0], [0, -1, 2, -1], [0, 0, -1, 1]]
GRAPH = networkx.Graph()
GRAPH.add_weighted_edges_from([(0, 1, 1.0), (1, 2, 2.0), (2, 3, 3.0)])


def written(write):
    stream = io.BytesIO()
    write(stream)
    return stream.getvalue()


def graph(write):
    return "\n".join(write(GRAPH)).encode()


MTX = written(lambda stream: scipy.io.mmwrite(stream, K))

#: Name of a file -> its content, what the message calls it, and K.
FILES = {
    "k.csv": (FRAME.to_csv(header=False, index=False).encode(), "a CSV file", K),
    "head.csv": (FRAME.to_csv(index=False).encode(), "a CSV file", K),
    "labels.csv": (FRAME.rename(columns="b{}".format).to_csv().encode(), "a CSV file", K),
    "bom.csv": (b"\xef\xbb\xbf" + FRAME.to_csv(header=False, index=False).encode(), "a CSV file", K),
    "comma.csv": (FRAME.to_csv(header=False, index=False, sep=";", decimal=",").encode(), "a CSV file", K),
    "k.tsv": (FRAME.to_csv(header=False, index=False, sep="\t").encode(), "a CSV file", K),
    "k.txt": (written(lambda stream: np.savetxt(stream, K, header="K")), "a text of numbers", K),
    "two.csv": (b"2,-1\n-1,2\n", "a CSV file", [[2, -1], [-1, 2]]),
    "edges.csv": (b"source,target,weight\n0,1,1.0\n1,2,2.0\n2,3,3.0\n3,3,0\n", "a text that lists edges", PATH),
    "edges.txt": (b"# from to weight\n0 1 1.0\n1 2 2.0\n2 3 3.0\n3 2 3.0\n", "a text that lists edges", PATH),
    "pairs.txt": (b"0\t1\n1\t2\n2\t3\n3\t2\n", "a text that lists edges", PAIRS),
    "v5.mat": (written(lambda stream: scipy.io.savemat(stream, {"K": K})), "a MATLAB file", K),
    "sparse.mat": (
        written(lambda stream: scipy.io.savemat(stream, {"K": scipy.sparse.csc_array(K)})), "a MATLAB file", K,
    ),
    "g.graphml": (graph(networkx.generate_graphml), "a text of GraphML", PATH),
    "g.gexf": (graph(networkx.generate_gexf), "a text of GEXF", PATH),
    "g.gml": (graph(networkx.generate_gml), "a text of GML", PATH),
    "g.net": (graph(networkx.generate_pajek), "a text for Pajek", PATH),
    "k.pkl": (pickle.dumps(K), "a pickle", K),
    "k.json": (json.dumps(K.tolist()).encode(), "JSON", K),
    "k.parquet": (written(FRAME.rename(columns=str).to_parquet), "a Parquet file", K),
    "k.feather": (written(FRAME.rename(columns=str).to_feather), "an Arrow file", K),
    "k.mtx.gz": (gzip.compress(MTX), "a file compressed by gzip", K),
    "k.mtx.bz2": (bz2.compress(MTX), "a file compressed by bzip2", K),
    "k.mtx.xz": (lzma.compress(MTX), "a file compressed by xz", K),
    'odd "name" \\.csv': (FRAME.to_csv(header=False, index=False).encode(), "a CSV file", K),
}  # fmt: skip


def message(file):
    with pytest.raises(SceneError) as refused:
        look_at_files(file.name, file.parent)
    return str(refused.value)


@pytest.mark.parametrize("name", FILES)
def test_the_line_converts_it(name, tmp_path, monkeypatch):
    content, kind, expected = FILES[name]
    (tmp_path / name).write_bytes(content)
    said = message(tmp_path / name)
    assert f"expected an .npz, .npy or Matrix Market file of K, got {kind}" in said
    _, _, line = said.partition("name what that writes: ")
    modules = {"numpy", "scipy", "pandas", "networkx", "pickle", "json", "gzip", "bz2", "lzma"}
    monkeypatch.chdir(tmp_path)
    exec(line, {module: __import__(module) for module in modules})
    (made,) = (file for file in tmp_path.iterdir() if file.name in ("K", "K.npz", "K.mtx"))
    found = arrays_of(made.read_bytes(), BY_BLOCK)["stiffness"]
    np.testing.assert_array_equal(found if isinstance(found, np.ndarray) else found.toarray(), expected)


def workbook():
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("xl/workbook.xml", "<workbook/>")
    return stream.getvalue()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\x89HDF\r\n\x1a\n" + bytes(64), ("an HDF5 file", "h5py.File(")),
        (b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n", ("a MATLAB file, version 7.3", '["K"][...].T')),
        (bytes(512) + b"\x89HDF\r\n\x1a\n", ("an HDF5 file", "h5py.File(")),
        (b"CDF\x01" + bytes(64), ("a NetCDF file", "netcdf_file")),
        (workbook(), ("a workbook", "read_excel")),
        (b"\xd0\xcf\x11\xe0" + bytes(64), ("an Excel file", "read_excel")),
        (b"a = 1\n[b]\nc = 2\n", ("something else", "numpy.savez")),
        (bytes(range(256)), ("something else", "numpy.savez")),
        (b"", ("it is empty",)),
    ],
)
def test_what_cannot_be_tried_here_is_named(content, words, tmp_path):
    (tmp_path / "K").write_bytes(content)
    said = message(tmp_path / "K")
    assert all(word in said for word in words), said


HEAD = b"%%MatrixMarket matrix coordinate real "


@pytest.mark.parametrize("symmetry", ["symmetric", "skew-symmetric"])
def test_a_file_of_one_triangle_that_lists_both_is_refused(symmetry):
    body = b"\n% of springs\n2 2 2\n2 1 -1.0\n\n1 2 -1.0\n"
    with pytest.raises(ValueError, match=r"expected one triangle .*\(1, 2\) at line 6 and \(2, 1\) too"):
        arrays_of(HEAD + symmetry.encode() + body, ())


def test_a_file_of_one_triangle_may_list_either():
    """Nor is a place that is listed twice, as where elements are summed, in both triangles."""
    text = b"symmetric\n3 3 5\n1 1 2.0\n1 2 -1.0\n3 1 4.0\n3 1 1.0\n3 3 1.0\n"
    expected = [[2.0, -1.0, 5.0], [-1.0, 0.0, 0.0], [5.0, 0.0, 1.0]]
    assert arrays_of(HEAD + text, ())["stiffness"].toarray().tolist() == expected


def test_a_diagonal_of_a_skew_file_is_refused_with_its_line():
    with pytest.raises(ValueError, match="got one at line 4"):
        arrays_of(HEAD + b"skew-symmetric\n2 2 2\n2 1 -1.0\n1 1 1.0\n", ())


@pytest.mark.parametrize("text", [MTX, HEAD + b"general\n1 1 1\n1 1 2.0\n"])
def test_a_last_line_without_an_end_is_read(text):
    whole, cut = (arrays_of(content, ())["stiffness"] for content in (text, text.rstrip()))
    assert (whole != cut).sum() == 0


@pytest.mark.parametrize("form", ["csc", "csr", "coo", "dia"])
def test_sparse_formats_are_taken(form):
    content = written(lambda stream: scipy.sparse.save_npz(stream, scipy.sparse.csc_array(K).asformat(form)))
    np.testing.assert_array_equal(arrays_of(content, ())["stiffness"].toarray(), K)


def test_another_sparse_format_is_refused_by_name():
    content = written(lambda stream: scipy.sparse.save_npz(stream, scipy.sparse.bsr_array(K)))
    with pytest.raises(ValueError, match=r"expected one of csc, csr, coo, dia, got bsr; save K\.tocsc\(\)"):
        arrays_of(content, ())


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"offsets": [0, 0]}, "each diagonal once"),
        ({"offsets": [0]}, "one for each row of data"),
        ({"data": [1.0, 2.0]}, "one for each row of data"),
    ],
)
def test_diagonals_that_do_not_fit_are_refused(change, said):
    parts = {"data": np.ones((2, 3)), "offsets": [0, 1], "shape": [3, 3], "format": b"dia"} | change
    with pytest.raises(ValueError, match=said):
        arrays_of(written(lambda stream: np.savez(stream, **parts)), ())


def test_a_row_of_more_numbers_than_there_may_be_blocks_is_not_taken_apart():
    with pytest.raises(ValueError, match="something else"):
        arrays_of(b"1," * 2_000_000 + b"1\n", BY_BLOCK)
