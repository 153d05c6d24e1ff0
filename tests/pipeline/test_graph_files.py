"""Graphs from files: all formats give one system, attributes are axes, and what is no graph of springs is refused."""

import networkx
import numpy as np
import pandas as pd
import pytest
import scipy.io
import scipy.sparse

from stickslip.pipeline import SceneError, StoreError, expand, load_scene, query, run_ensemble
from stickslip.pipeline.scene.graph_files import graph_of
from tests.scenes import ENDING

SCENE = (
    """\
[system]
coupling = "graph"
path = "G*"
kappa = [0.5, 2.0]
leaf = 0.25
damping = 0.1
[start]
z = {uniform = [-1, 1]}
w = "belt"
[run]
t_end = 5.0
matrices = 1
"""
    + ENDING
)
GRAPHML = (
    '<graphml xmlns="http://graphml.graphdrawing.org/xmlns"><key id="w" for="edge" attr.name="weight"'
    ' attr.type="double"><default>2.5</default></key><graph edgedefault="undirected">{}</graph></graphml>'
)
NODES = '<node id="a"/><node id="b"/><edge source="b" target="a"/>'


@pytest.fixture
def graph(rng):
    graph = networkx.gnp_random_graph(12, 0.4, seed=3)
    for i, j in graph.edges:
        graph[i][j]["weight"] = round(rng.uniform(0.5, 2.0), 3)
    graph.graph |= {"rewiring": 0.1, "name": "twelve"}
    return graph


def csv(graph, **numbers):
    lines = [f"# {name} = {number}" for name, number in numbers.items()]
    rows = [f"{i},{j},{weight}" for i, j, weight in graph.edges(data="weight", default=1.0)]
    return "\n".join([*lines, "i,j,weight", *rows]) + "\n"


def scene(folder, text=SCENE):
    (folder / "mine.toml").write_text(text)
    return load_scene(folder / "mine.toml")


def test_all_formats_hold_one_system(graph, tmp_path):
    adjacency = networkx.to_scipy_sparse_array(graph, dtype=float)
    (tmp_path / "G.csv").write_text(csv(graph, model="e", by="Zoë"))
    (tmp_path / "G.txt").write_text(csv(graph).replace(",", " ").replace("i j weight", "% i j weight"))
    del graph.graph["rewiring"]
    networkx.write_graphml(graph, tmp_path / "G.graphml")
    scipy.io.mmwrite(tmp_path / "G.mtx", scipy.sparse.coo_array(adjacency), symmetry="symmetric")
    scipy.sparse.save_npz(tmp_path / "G.npz", adjacency)
    np.save(tmp_path / "G.npy", adjacency.toarray())
    np.savez(tmp_path / "Gd.npz", adjacency=adjacency.toarray())
    pd.DataFrame(adjacency.toarray()).to_csv(tmp_path / "Ga.csv", header=False, index=False)
    pd.DataFrame(adjacency.toarray()).add_prefix("b").to_csv(tmp_path / "Gb.csv", index=False)
    members = expand(scene(tmp_path))
    assert len(members) == 9 * 2
    laplacian = networkx.laplacian_matrix(graph).toarray()
    for member in members:
        expected = member.term("kappa") * laplacian + 0.25 * np.eye(12)
        np.testing.assert_allclose(member.system().stiffness.toarray(), expected, rtol=1e-13, atol=1e-13)
        assert member.row()["coupling"] == "graph"


def test_attributes_are_axes_and_realisations_are_compared(tmp_path):
    """By the names of the couplings that are drawn, which have these columns too."""
    for k, p in enumerate((0.0, 0.2)):
        for number in range(3):
            graph = networkx.watts_strogatz_graph(10, 4, p, seed=number)
            if number == 2:
                graph.graph |= {"degree": 4.0, "rewiring": p, "realisation": number}
                networkx.write_graphml(graph, tmp_path / f"G{k}-{number}")
            else:
                text = csv(graph, degree=4, rewiring=p, realisation=number)
                (tmp_path / f"G{k}-{number}").write_text(text)
    swept = scene(tmp_path, SCENE.replace("[start]", "[record]\nstructure = true\n[start]"))
    run_ensemble(swept, tmp_path / "out", workers=0)
    design = expand(swept).ensemble.design
    assert {axis.name for axis in design.axes} == {"degree", "rewiring", "kappa"}
    table = query.members(tmp_path / "out")
    assert len(table) == 2 * 3 * 2
    assert (table.degree == 4.0).all()
    assert sorted(table.rewiring.unique()) == [0.0, 0.2]
    assert (table.groupby(["design_point", "rewiring", "kappa"]).design_unit.nunique() == 3).all()
    assert table.columns.is_unique


def test_a_graph_that_changed_is_another_scene(graph, tmp_path):
    (tmp_path / "G.csv").write_text(csv(graph))
    run_ensemble(scene(tmp_path), tmp_path / "out", workers=0)
    graph[0][next(iter(graph[0]))]["weight"] = 9.0
    (tmp_path / "G.csv").write_text(csv(graph))
    with pytest.raises(StoreError, match=r"system\.files\.G\.csv: sha256"):
        run_ensemble(scene(tmp_path), tmp_path / "out", workers=0)


BOMB = b'<!DOCTYPE g [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]>'


@pytest.mark.parametrize(("content", "words"), [
    (BOMB + GRAPHML.format(NODES).encode(), "no document type, which could declare entities"),
    ((BOMB.decode() + GRAPHML.format(NODES)).encode("utf-16-le"), "no document type, which could declare entities"),
    (GRAPHML.format(NODES).replace("2.5", "1_0").encode(), "weights in plain digits, got '1_0' between b and a"),
    (GRAPHML.format(NODES).replace("2.5", "\u0663").encode(), "weights in plain digits"),
    (GRAPHML.format(NODES[:-2] + ">" + 2 * '<data key="w">1</data>' + "</edge>").encode(), "one key twice"),
    (GRAPHML.format(NODES).replace('"undirected"', '"directed"').encode(), "got a directed graph"),
    (GRAPHML.format(NODES.replace("<edge", '<edge directed="true"')).encode(), "undirected edges, got a directed"),
    (GRAPHML.format(NODES.replace('"b"/><edge', '"c"/><edge')).encode(), "edges between nodes, got 'b'"),
    (GRAPHML.format(NODES + "<hyperedge/>").encode(), "got a hyperedge"),
    (GRAPHML.format(NODES + NODES).encode(), "each node once, got 'a' twice"),
    (b"<graphml/>", "expected one graph, got none"),
    (GRAPHML.format(NODES).replace("</graph>", "</graph><graph/>").encode(), "one graph, got more"),
    (GRAPHML.format(NODES).encode()[:-30], "no element found|unclosed token|mismatched"),
    (b"", "something else"),
    (b"i,j\n", "something else"),
    (b"0,1\n1,2,3\n", "expected 3 columns, as in the last line, got 0, 1"),
    (b"0 1 {'weight': 1.0}\n", "data=False"),
    (b"1,2\n2,3\n", "blocks counted from 0"),
    (b"0,99999999\n", "expected at most"),
    (b"0,x\n", "something else"),
    (b"\xff\xfe0", "something else"),
    (b"0 1 1 0\n1 0 0 1\n1 0 0 1\n0 1 2 0\n", "symmetric adjacency"),
])  # fmt: skip
def test_what_is_no_graph_is_refused_with_a_reason(content, words, tmp_path):
    (tmp_path / "G").write_bytes(content)
    with pytest.raises(SceneError, match=rf"G: expected a graph: rows i, j .*(?:{words}).*; correct|got none"):
        scene(tmp_path)


def test_defaults_of_graphml_hold_where_an_edge_says_nothing():
    edges = graph_of(GRAPHML.format(NODES).encode(), ())["edges"]
    assert (edges.n, edges.pairs.tolist(), edges.weights.tolist()) == (2, [[0, 1]], [2.5])
    of_nodes = GRAPHML.format(NODES).replace('for="edge"', 'for="node"').encode()
    assert graph_of(of_nodes, ())["edges"].weights.tolist() == [1.0]


def test_edges_where_k_is_expected_are_told_how_they_are_read(graph, tmp_path):
    (tmp_path / "G.csv").write_text(csv(graph))
    text = SCENE.replace('"graph"', '"file"').replace("kappa = [0.5, 2.0]\nleaf = 0.25\n", "rho = 3.5\n")
    with pytest.raises(SceneError, match='if it lists edges, coupling = "graph" reads it'):
        scene(tmp_path, text)


def test_structure_is_that_of_networkx(tmp_path):
    graphs = [
        networkx.gnp_random_graph(30, 0.08, seed=1),  # in several parts
        networkx.barabasi_albert_graph(40, 2, seed=2),
        networkx.watts_strogatz_graph(25, 4, 0.2, seed=3),
        networkx.empty_graph(3),
    ]
    for k, graph in enumerate(graphs):
        np.save(tmp_path / f"G{k}.npy", networkx.to_numpy_array(graph))
    text = SCENE.replace("[start]", "[record]\nstructure = true\n[start]").replace("[0.5, 2.0]", "2.0")
    run_ensemble(scene(tmp_path, text), tmp_path / "out", workers=0)
    table = query.members(tmp_path / "out").set_index("file")
    for k, graph in enumerate(graphs):
        row = table.loc[f"G{k}.npy"]
        parts = [graph.subgraph(part) for part in networkx.connected_components(graph)]
        pairs = [len(part) * (len(part) - 1) for part in parts]
        lengths = [networkx.average_shortest_path_length(part) if len(part) > 1 else 0.0 for part in parts]
        assert row.mean_degree == pytest.approx(2 * graph.number_of_edges() / len(graph))
        assert row.clustering == pytest.approx(networkx.average_clustering(graph))
        assert row.n_components == len(parts)
        if sum(pairs):
            assert row.path_length == pytest.approx(np.dot(pairs, lengths) / sum(pairs))
        else:
            assert pd.isna(row.path_length)
        largest = np.linalg.eigvalsh(networkx.laplacian_matrix(graph).toarray().astype(float))[-1]
        assert row.largest_eigenvalue == pytest.approx(2.0 * largest + 0.25)
