"""What the bytes of a file of a graph hold: edges, GraphML or an adjacency matrix, and numbers beside them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np

from stickslip.pipeline.scene.readers.text import Text
from stickslip.pipeline.scene.system_files import arrays_of
from stickslip.pipeline.scene.toml import MAX_BLOCKS
from stickslip.sim.systems.graphs import adjacent_edges, edges_of, listed_edges

_MATRICES = (b"PK", b"\x93NUMPY", b"%%MatrixMarket")
#: What a comment in a text of edges carries, as `# rewiring = 0.1`.
_REMARK = re.compile(rb"^[ \t]*[#%][ \t]*(\w+)[ \t]*=[ \t]*(\S+)[ \t]*\r?$", re.MULTILINE | re.ASCII)
#: A number in plain digits.
_PLAIN = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", re.ASCII)


def graph_of(content: bytes, names: Sequence[str]) -> dict[str, Any]:
    """The `edges` of a graph, as `Edges`; with a matrix, the arrays of some names, as in `arrays_of`.

    Numbers that the graph carries are `parameters`, by name. The readers of Python, NumPy and Expat raise exceptions
    of many kinds for damaged files. Raises `ValueError` if there is no undirected graph.
    """
    if content.startswith(_MATRICES):
        arrays = arrays_of(content, names, "adjacency")
        adjacency = arrays.pop("adjacency")
        arrays["edges"] = adjacent_edges(adjacency) if isinstance(adjacency, np.ndarray) else edges_of(adjacency)
    elif content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
        arrays = _of_graphml(content)
    else:
        arrays = _of_text(content)
    if arrays["edges"].n > MAX_BLOCKS:
        raise ValueError(f"expected at most {MAX_BLOCKS} blocks, got {arrays['edges'].n}")
    return arrays


def _of_text(content: bytes) -> dict[str, Any]:
    """A text of numbers: of two or three columns edges, of more an adjacency matrix; a first line of names."""
    if content.rstrip().endswith(b"}"):
        raise ValueError("expected numbers, got the attributes of edges; write_edgelist(..., data=False)")
    table = np.column_stack(Text(content).columns(()))
    edges = listed_edges(table, None) if table.shape[1] in (2, 3) else adjacent_edges(table)
    return _with_numbers(edges, {name.decode(): text.decode("latin-1") for name, text in _REMARK.findall(content)})


class _WithoutType(ElementTree.TreeBuilder):
    """A document, in any encoding, that declares no entities."""

    def doctype(self, *_: object) -> None:
        raise ValueError("expected no document type, which could declare entities, got one; remove <!DOCTYPE ...>")


def _of_graphml(content: bytes) -> dict[str, Any]:
    """The graph of a document of graphml.graphdrawing.org: nodes in their order, weights from the key `weight`."""
    document = ElementTree.fromstring(content, ElementTree.XMLParser(target=_WithoutType()))
    graphs = document.findall(".//{*}graph")
    if len(graphs) != 1:
        raise ValueError(f"expected one graph, got {'more' if graphs else 'none'}")
    (graph,) = graphs
    if graph.get("edgedefault") != "undirected":
        raise ValueError('expected edgedefault="undirected", as a spring pulls both its blocks, got a directed graph')
    if graph.find("{*}hyperedge") is not None:
        raise ValueError("expected edges between two nodes, got a hyperedge")
    attributes = {key.get("id"): key.get("attr.name", "") for key in document.findall("{*}key")}
    defaults = {
        key.get("attr.name"): key.findtext("{*}default")
        for key in document.findall("{*}key")
        if key.get("for", "all") in ("edge", "all")
    }

    def values(element: ElementTree.Element) -> dict[str, str]:
        data = element.findall("{*}data")
        texts = {attributes.get(value.get("key"), ""): (value.text or "").strip() for value in data}
        if len(texts) < len(data):
            raise ValueError("expected different data of a node, an edge or a graph, got one key twice")
        return texts

    nodes: dict[str | None, int] = {}
    for node in graph.findall("{*}node"):
        if node.get("id") in nodes:
            raise ValueError(f"expected each node once, got {node.get('id')!r} twice")
        nodes[node.get("id")] = len(nodes)
    rows = []
    for edge in graph.findall("{*}edge"):
        ends = [edge.get("source"), edge.get("target")]
        strange = next((end for end in ends if end not in nodes), None)
        if strange is not None:
            raise ValueError(f"expected edges between nodes, got {strange!r}, which is none")
        if edge.get("directed", "false") != "false":
            raise ValueError("expected undirected edges, got a directed one")
        weight = values(edge).get("weight") or defaults.get("weight") or "1"
        if not _PLAIN.fullmatch(weight):
            raise ValueError(f"expected weights in plain digits, got {weight!r:.40} between {ends[0]} and {ends[1]}")
        rows.append([*(nodes[end] for end in ends), float(weight)])
    return _with_numbers(listed_edges(np.array(rows, np.float64).reshape(-1, 3), len(nodes)), values(graph))


def _with_numbers(edges: Any, texts: dict[str, str]) -> dict[str, Any]:
    """The edges, and those of some texts beside them that are numbers, by name."""
    numbers = {name: float(text) for name, text in texts.items() if name.isidentifier() and _PLAIN.fullmatch(text)}
    return {"edges": edges} | ({"parameters": numbers} if numbers else {})
