"""Files that other programs write: numbers are read, or a file is named with the line of Python that converts it."""

import bz2
import gzip
import io
import json
import lzma
import os
import pickle
import zipfile

import networkx
import numpy as np
import pandas as pd
import pytest
import scipy.io
import scipy.sparse

from stickslip.pipeline import SceneError
from stickslip.pipeline.scene.readers.reader import in_child
from stickslip.pipeline.scene.system_files import arrays_of, series_of
from stickslip.pipeline.scene.systems import BY_BLOCK, look_at_files

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
}  # fmt: skip


def message(file):
    with pytest.raises(SceneError) as refused:
        look_at_files(file.name, file.parent, {"damping": 0.0})
    return str(refused.value)


@pytest.mark.parametrize("name", FILES)
def test_the_line_converts_it(name, tmp_path, monkeypatch):
    content, kind, expected = FILES[name]
    (tmp_path / name).write_bytes(content)
    said = message(tmp_path / name)
    assert f"a .mat or a CSV file of K, got {kind}" in said
    _, _, line = said.partition("name what that writes: ")
    modules = {"numpy", "scipy", "pandas", "networkx", "pickle", "json", "gzip", "bz2", "lzma"}
    monkeypatch.chdir(tmp_path)
    exec(line, {module: __import__(module) for module in modules})
    (made,) = (file for file in tmp_path.iterdir() if file.name in ("K", "K.npz", "K.mtx"))
    found = arrays_of(made.read_bytes(), BY_BLOCK)["stiffness"]
    np.testing.assert_array_equal(found if isinstance(found, np.ndarray) else found.toarray(), expected)


def mat(**arrays):
    return written(lambda stream: scipy.io.savemat(stream, arrays))


#: Contents of files, each of which holds K.
READ = {
    "comma": FRAME.to_csv(header=False, index=False).encode(),
    "pandas": FRAME.to_csv(index=False).encode(),
    "numbered": FRAME.to_csv().encode(),
    "labels": FRAME.rename(columns="b{}".format).to_csv().encode(),
    "names": FRAME.rename("b{}".format).to_csv(header=False).encode(),
    "mark": b"\xef\xbb\xbf" + FRAME.to_csv(header=False, index=False).encode(),
    "semicolon": FRAME.to_csv(header=False, index=False, sep=";", decimal=",").encode(),
    "wholes last": FRAME[::-1].to_csv(header=False, index=False, sep=";", decimal=",").encode(),
    "tab": FRAME.to_csv(header=False, index=False, sep="\t").encode(),
    "trailing": FRAME.to_csv(header=False, index=False, lineterminator=",\r\n").encode(),
    "utf-16": FRAME.to_csv(header=False, index=False).encode("utf-16"),
    "blanks": written(lambda stream: np.savetxt(stream, K, header="K")),
    "blanks and commas": written(lambda stream: np.savetxt(stream, K)).replace(b".", b","),
    "heads": ("Kräfte in N/µm\n\na;b;c;d\n" + FRAME.to_csv(header=False, index=False, sep=";")).encode("latin-1"),
    "mat": mat(anything=K),
    "packed": written(lambda stream: scipy.io.savemat(stream, {"K": K}, do_compression=True)),
    "sparse": mat(K=scipy.sparse.csc_array(K)),
    "K of others": mat(K=K, M=np.ones(4), C=np.eye(4)),
}  # fmt: skip


@pytest.mark.parametrize("case", READ)
def test_numbers_are_read_as_they_were_written(case):
    found = arrays_of(READ[case], BY_BLOCK)["stiffness"]
    expected = K[::-1] if case == "wholes last" else K
    np.testing.assert_array_equal(found if isinstance(found, np.ndarray) else found.toarray(), expected)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"1,2\n3,4,5\n6,7\n", r"line 2: expected 2 columns, as in the last line, got 3"),
        (b'"1,200.5",-6,0\n-6,9,-6\n0,-6,9\n', r"line 1, column 1: expected a finite number, got '1,200.5'"),
        (b"1,200.5,-6,0\n-6,9,-6\n0,-6,9\n", r"expected 3 columns, as in the last line, got 1, 200.5, -6, 0"),
        (b"1,2\n3,\n", r"line 2, column 2: expected a finite number, got ''; correct it"),
        (b"# a\n1,2\n3,nan\n", r"line 3, column 2: expected a finite number, got 'nan'"),
        (b"1,2\n3,1+2j\n", r"line 2, column 2: expected a finite number, got '1\+2j'"),
        (b"1;2\n3;1.000,5\n", r"line 2, column 2: expected a finite number, got '1\.000,5'"),
        (b"0,x\n1,2\n3,4\n", r"line 1, column 2: expected a finite number, got 'x'"),
        (b"0,1,1.0\n1,2,2.0\n2,3,3.0\n3,3,0\n", r"the shape \(4, 3\); if it lists edges, coupling = .graph. reads"),
        (b"source,target,weight\n0,1,1.0\n", r"the shape \(3,\); if it lists edges, coupling = .graph. reads"),
        (mat(A=K, B=K), r"expected an array `stiffness` or `K`.* got A, B; save these alone, or say which"),
        (mat(K=K, stiffness=K), r"expected each array once, got K, stiffness"),
        (mat(K=1j * K), r"K: expected real numbers, got complex ones; save real\(K\)"),
        (mat(K="text"), r"K: expected an array of real numbers, got text"),
        (mat(s={"K": K}), r"s: expected an array of real numbers, got a struct; save its field"),
        (mat(K=np.ones((2, 2, 2))), r"K: expected a row or a matrix, got the shape \(2, 2, 2\)"),
        (mat(K=K, M=K), r"mass: .* a diagonal matrix, got -1 at row 1, column 2; lump it"),
        (mat(K=K)[:-7], r"."),
    ],
)  # fmt: skip
def test_what_goes_wrong_with_numbers_is_said(content, words):
    with pytest.raises(ValueError, match=words):
        arrays_of(content, BY_BLOCK)


def test_masses_are_the_diagonal_of_their_matrix():
    for mass in (np.diag([1.0, 2.0, 3.0, 4.0]), scipy.sparse.diags_array([1.0, 2.0, 3.0, 4.0]).tocsc(), [1, 2, 3, 4]):
        assert arrays_of(mat(K=K, M=mass, names=["table", "bit"]), BY_BLOCK)["mass"].tolist() == [1.0, 2.0, 3.0, 4.0]


def test_a_reader_that_crashes_is_a_file_that_is_refused():
    with pytest.raises(ValueError, match="its reader died"):
        in_child(os._exit, 3)


TIMES, SPEEDS = np.arange(4.0), np.array([0.0, 0.5, 0.5, -0.25])
ROWS = np.column_stack([TIMES, SPEEDS])


@pytest.mark.parametrize(
    ("content", "columns"),
    [
        (b"t,v\n" + pd.DataFrame(ROWS).to_csv(header=False, index=False).encode(), ()),
        (b"n;t;v\n;s;m/s\n" + pd.DataFrame(ROWS).to_csv(header=False, sep=";", decimal=",").encode(), ("t", "m/s")),
        (pd.DataFrame(ROWS).to_csv(header=False, sep="\t").encode(), (1, 2)),
        (mat(log=ROWS), ()),
        (mat(t=TIMES, omega=SPEEDS[:, None]), ()),
        (mat(time=TIMES, omega=SPEEDS, torque=TIMES), ("time", "omega")),
        (written(lambda stream: np.savez(stream, values=SPEEDS, times=TIMES)), ()),
        (written(lambda stream: np.save(stream, ROWS)), ()),
    ],
)  # fmt: skip
def test_a_series_is_two_columns(content, columns):
    times, values = series_of(content, columns)
    assert times.tolist() == TIMES.tolist()
    assert values.tolist() == SPEEDS.tolist()


@pytest.mark.parametrize(("content", "columns", "words"), [
    (b"0,1,2\n1,2,3\n", (), r'expected two columns, got 3; name two, as columns = \["t", "v"\]'),
    (b"t,v\n0,1\n", ("t", "w"), r"expected a column 'w', got 't', 'v'"),
    (b"0,1\n", ("t", "v"), r"expected a column 't', got none with a heading; give numbers from 0"),
    (b"0,1\n", (0, 2), r"expected a column from 0 to 1, got 2"),
    (mat(a=TIMES, b=TIMES), (), r'expected two arrays, got a, b; name two, as columns = \["t", "v"\]'),
    (mat(t=TIMES, v=TIMES[:2]), (), r"expected as many times as values, got 4 and 2"),
    (mat(t=TIMES, v=TIMES), ("t", "w"), r"expected an array 'w', got t, v"),
])  # fmt: skip
def test_what_is_no_series_is_refused(content, columns, words):
    with pytest.raises(ValueError, match=words):
        series_of(content, columns)


def workbook():
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("xl/workbook.xml", "<workbook/>")
    return stream.getvalue()


@pytest.mark.parametrize(("content", "words"), [
    (b"\x89HDF\r\n\x1a\n" + bytes(64), ("an HDF5 file", "h5py.File(")),
    (b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n",
        ("a MATLAB file of version 7.3, which is HDF5: in MATLAB save it with -v7", '["K"][...].T')),
    (bytes(512) + b"\x89HDF\r\n\x1a\n", ("an HDF5 file", "h5py.File(")),
    (b"CDF\x01" + bytes(64), ("a NetCDF file", "netcdf_file")),
    (workbook(), ("a workbook", "read_excel")),
    (b"\xd0\xcf\x11\xe0" + bytes(64), ("an Excel file", "read_excel")),
    (b"a = 1\n[b]\nc = 2\n", ("something else", "correct the file")),
    (bytes(range(256)), ("something else", "correct the file")),
    (b"", ("it is empty",)),
])  # fmt: skip
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
    with pytest.raises(ValueError, match=r"expected one of csc, csr, coo, dia, got b'bsr'; save K\.tocsc\(\)"):
        arrays_of(content, ())


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"offsets": [0, 0]}, "duplicate"),
        ({"offsets": [0]}, "does not match the number of offsets"),
        ({"data": [1.0, 2.0]}, "does not match the number of offsets"),
    ],
)
def test_diagonals_that_do_not_fit_are_refused(change, said):
    parts = {"data": np.ones((2, 3)), "offsets": [0, 1], "shape": [3, 3], "format": b"dia"} | change
    with pytest.raises(ValueError, match=said):
        arrays_of(written(lambda stream: np.savez(stream, **parts)), ())


def test_a_row_of_more_numbers_than_there_may_be_blocks_is_not_taken_apart():
    with pytest.raises(ValueError, match="something else"):
        arrays_of(b"1," * 2_000_000 + b"1\n", BY_BLOCK)
