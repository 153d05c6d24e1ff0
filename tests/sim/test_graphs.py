"""Springs along graphs: K beside networkx, the graphs that are drawn beside the laws of their authors, refusals."""

import networkx
import numpy as np
import pytest
import scipy.sparse

from stickslip import System, draw_system
from stickslip.sim.systems.graphs import drawn_edges


def drawn(name, n, seed, degree, rewiring=0.1):
    edges = drawn_edges(name, n, np.random.default_rng(seed), degree, rewiring)
    graph = networkx.Graph()
    graph.add_nodes_from(range(n))
    graph.add_edges_from(edges.pairs.tolist())
    assert graph.number_of_edges() == len(edges.pairs)  # each pair once
    assert (edges.pairs[:, 0] < edges.pairs[:, 1]).all()
    return graph


def test_k_is_kappa_times_the_laplacian_and_the_leaf_springs(rng):
    for n in (1, 2, 7, 40):
        graph = networkx.gnp_random_graph(n, 0.3, seed=int(rng.integers(10**6)))
        for i, j in graph.edges:
            graph[i][j]["weight"] = rng.uniform(0.5, 2.0)
        kappa, leaf, order = rng.uniform(0.1, 5.0), rng.uniform(0.0, 1.0, n), rng.permutation(n).tolist()
        expected = kappa * networkx.laplacian_matrix(graph, order).toarray() + np.diag(leaf)
        shuffled = networkx.Graph()
        shuffled.add_nodes_from(order)
        shuffled.add_edges_from((j, i, data) for i, j, data in graph.edges(data=True))
        adjacency = networkx.to_scipy_sparse_array(graph, order, dtype=float)
        place = {node: k for k, node in enumerate(order)}
        edges = [(place[i], place[j], data["weight"]) for i, j, data in graph.edges(data=True)]
        for given in (shuffled, adjacency, scipy.sparse.lil_array(adjacency), np.array(edges).reshape(-1, 3)):
            system = System.from_graph(given, kappa=kappa, leaf=leaf, n=n, friction=0.5)
            np.testing.assert_allclose(system.stiffness.toarray(), expected, rtol=1e-14, atol=1e-14)
            assert (system.friction == 0.5).all()


def bad_sparse():
    return scipy.sparse.csr_array(([1.0], [7], [0, 1, 1]), shape=(2, 2))


@pytest.mark.parametrize(
    ("graph", "words"),
    [
        (networkx.DiGraph([(0, 1)]), "expected an undirected one, .* got a directed one; pass graph.to_undirected"),
        (networkx.Graph([(0, 0)]), "springs between two blocks, .* got 0, 0, 1 at edge 0"),
        (networkx.MultiGraph([(0, 1), (1, 0)]), "each pair once, .* got 0, 1, 1 at edge 1"),
        ([[0, 1], [1, 2], [1, 0]], "each pair once, in one order, .* got 1, 0 at edge 2"),
        ([[0, 1.5]], "whole numbers of blocks, got 0, 1.5"),
        ([[0, 1e300]], "whole numbers of blocks"),
        ([[0, 1, np.inf]], "weights from 0 up, .*got 0, 1, inf at edge 0"),
        ([[0, 1, -2.0]], "weights from 0 up, .*got 0, 1, -2 at edge 0"),
        ([[1, 2], [2, 3]], "each block from 0 on at a spring, got none of 0, and 1 as the next"),
        ([[0, 1], [1, 3]], "got none of 2, and 3 as the next; number them without a gap, or, if that has no springs"),
        (np.eye(5)[::-1], r"\(m, 2\) or \(m, 3\), got shape \(5, 5\); pass an adjacency matrix as scipy.sparse"),
        (scipy.sparse.csr_array(np.triu(np.ones((3, 3)), 1)), r"symmetric adjacency, .* at \(0, 1\) and \(1, 0\)"),
        (scipy.sparse.eye_array(3), "zeros on its diagonal, got 1 at block 0; pass a Laplacian, or K, to System"),
        (scipy.sparse.csr_array((2, 3)), r"square adjacency matrix, got shape \(2, 3\)"),
        (bad_sparse(), "indices in range"),
    ],
)  # fmt: skip
def test_what_is_no_graph_of_springs_is_refused_by_name(graph, words):
    with pytest.raises(ValueError, match=f"graph: .*{words}"):
        System.from_graph(graph, kappa=1.0, leaf=0.1)


def test_blocks_beyond_the_edges_are_there_if_n_says_so():
    system = System.from_graph([[1, 2]], n=4, leaf=1.0)
    assert system.n == 4
    with pytest.raises(ValueError, match="blocks from 0 to n - 1 = 1, got 1, 2 at edge 0"):
        System.from_graph([[1, 2]], n=2)


def test_a_small_world_is_a_ring_that_is_rewired(rng):
    """C(p) / C(0) near (1 - p)^3, as Barrat and Weigt, Eur. Phys. J. B 13 (2000) 547; what is moved stays moved."""
    n, seed = 2000, int(rng.integers(10**6))
    ring = drawn("small_world", n, seed, 6, 0.0)
    pairs = drawn_edges("small_world", n, np.random.default_rng(seed), 6, 0.0).pairs
    assert networkx.utils.graphs_equal(ring, networkx.watts_strogatz_graph(n, 6, 0.0))
    was_moved = np.zeros(3 * n, dtype=bool)
    for p in (0.05, 0.3, 1.0):
        graph = drawn("small_world", n, seed, 6, p)
        is_moved = np.any(drawn_edges("small_world", n, np.random.default_rng(seed), 6, p).pairs != pairs, axis=1)
        assert is_moved.mean() == pytest.approx(p, abs=6 * np.sqrt(p * (1 - p) / (3 * n)))
        assert is_moved[was_moved].all()
        was_moved = is_moved
        clustering = networkx.average_clustering(graph) / 0.6  # 3 (k - 2) / (4 (k - 1))
        assert clustering == pytest.approx((1 - p) ** 3, abs=0.08)


def test_degrees_of_a_scale_free_network_follow_the_law_of_preferential_attachment(rng):
    """p(k) = 2 m (m + 1) / (k (k + 1) (k + 2)): Bollobas et al., Random Struct. Algorithms 18 (2001) 279."""
    n = 4000
    for m in (1, 2, 3):
        graph = drawn("scale_free", n, int(rng.integers(10**6)), 2 * m)
        degrees = np.array([degree for _, degree in graph.degree])
        assert graph.number_of_edges() == m * (n - m)
        assert networkx.is_connected(graph)
        for k in (m, m + 1, m + 3):
            expected = 2 * m * (m + 1) / (k * (k + 1) * (k + 2))
            assert (degrees == k).mean() == pytest.approx(expected, abs=6 * np.sqrt(expected / n))


def test_every_block_of_a_random_regular_graph_has_one_degree(rng):
    for n, degree in ((4, 3), (10, 0), (50, 3), (51, 8), (60, 45)):
        graph = drawn("random_regular", n, int(rng.integers(10**6)), degree)
        assert {k for _, k in graph.degree} == {degree}


@pytest.mark.parametrize(
    ("name", "degree", "words"),
    [
        ("small_world", 3, "an even number from 2 to n - 1 = 9"),
        ("scale_free", 10, "an even number from 2 to n - 1 = 9"),
        ("random_regular", 2.5, "a whole number of at most n - 1 = 9"),
        ("network", 9.5, "at most n - 1 = 9, all the others"),
    ],
)
def test_a_degree_that_a_graph_cannot_have_is_refused(name, degree, words):
    with pytest.raises(ValueError, match=f"degree: expected {words}, got {degree}"):
        draw_system(name, 10, 0, degree=degree)
    with pytest.raises(ValueError, match="degree: expected an even number with n = 9, as each spring has two ends"):
        draw_system("random_regular", 9, 0, degree=3)
    with pytest.raises(ValueError, match=r"rewiring: expected a probability from 0 to 1, got 1\.5"):
        draw_system("small_world", 9, 0, rewiring=1.5)
