"""What the bytes of a file of a graph hold: edges, GraphML or an adjacency matrix, and numbers beside them."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from typing import Any, TextIO
from xml.parsers import expat

import numpy as np

from stickslip.pipeline.scene.system_files import arrays_of
from stickslip.pipeline.scene.toml import MAX_BLOCKS
from stickslip.sim.systems.graphs import Edges, adjacent_edges, edges_of, listed_edges

_MATRICES = (b"PK", b"\x93NUMPY", b"%%MatrixMarket")
#: A number that a comment in a text of edges carries, as `# rewiring = 0.1`.
_NUMBER = re.compile(r"[#%]\s*(\w+)\s*=\s*(\S+)\s*")
#: Characters between numbers, beside blanks.
_BLANKS = str.maketrans(",;\t", "   ")
#: Rows of a text at most, some seconds, and characters of one: a row of an adjacency of the most blocks.
_MOST_ROWS, _LONGEST = 5_000_000, 25 * MAX_BLOCKS


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
        arrays = _GraphML(content).arrays
    else:
        arrays = _table(content)
    if arrays["edges"].n > MAX_BLOCKS:
        raise ValueError(f"expected at most {MAX_BLOCKS} blocks, got {arrays['edges'].n}")
    return arrays


def _table(content: bytes) -> dict[str, Any]:
    """A text of numbers: of two or three columns edges, of more an adjacency matrix; a first line of names.

    Read line by line, so that what is none is refused at its first line that is none, however long it is.
    """
    parameters: dict[str, float] = {}
    rows = islice(_rows(io.TextIOWrapper(io.BytesIO(content), "utf-8-sig"), parameters), _MOST_ROWS + 1)
    first = next(rows, None)
    if first is None:
        raise ValueError("it has no edge")
    table = np.loadtxt(chain([first], rows), ndmin=2, comments=None)
    if len(table) > _MOST_ROWS:
        raise ValueError(
            f"expected at most {_MOST_ROWS} rows of text, got more; save an adjacency by scipy.sparse.save_npz"
        )
    edges = listed_edges(table, None) if table.shape[1] in (2, 3) else adjacent_edges(table)
    return {"edges": edges} | ({"parameters": parameters} if parameters else {})


def _rows(text: TextIO, parameters: dict[str, float]) -> Iterator[str]:
    """The rows of numbers of a text; numbers in its comments are added to `parameters`."""
    is_first = True
    while line := text.readline(_LONGEST + 1):
        if len(line) > _LONGEST:
            raise ValueError(f"expected lines of at most {_LONGEST} characters, got a longer one")
        line = line.strip()
        if not line:
            continue
        if line[0] in "#%":
            match = _NUMBER.fullmatch(line)
            if match and match[1].isidentifier():
                parameters[match[1]] = float(match[2])
            continue
        is_heading = is_first and re.match(r"[^\d.+-]", line.lstrip("\"' "))
        is_first = False
        if line.endswith("}"):
            raise ValueError("expected numbers, got the attributes of edges; write_edgelist(..., data=False)")
        if not is_heading:
            yield line.translate(_BLANKS)


class _GraphML:
    """The graph of a document of graphml.graphdrawing.org: nodes in their order, weights from the key `weight`."""

    def __init__(self, content: bytes) -> None:
        self._keys: dict[str, str] = {}
        self._weight = "1"
        self._nodes: dict[str, int] = {}
        self._ends: list[tuple[str, str]] = []
        self._weights: list[str] = []
        self._numbers: dict[str, str] = {}
        self._path: list[str] = []
        self._key = ""
        self._text: list[str] = []  # as Expat gives it: a piece a line, or a reference
        self._has_graph = False
        parser = expat.ParserCreate(namespace_separator=" ")
        parser.StartDoctypeDeclHandler = self._refuse_type  # whoever declares no entities has none
        parser.StartElementHandler, parser.EndElementHandler = self._start, self._end
        parser.CharacterDataHandler = self._text.append
        parser.Parse(content, True)

    @property
    def arrays(self) -> dict[str, Any]:
        """As of `graph_of`."""
        if not self._has_graph:
            raise ValueError("expected one graph, got none")
        strange = next((end for ends in self._ends for end in ends if end not in self._nodes), None)
        if strange is not None:
            raise ValueError(f"expected edges between nodes, got {strange!r}, which is none")
        edges = [(self._nodes[i], self._nodes[j]) for i, j in self._ends]
        table = np.column_stack((np.array(edges).reshape(-1, 2), np.array(self._weights, dtype=np.float64)))
        parameters = {}
        for name, text in self._numbers.items():
            if name.isidentifier() and re.fullmatch(r"[-+.\deE]+", text):
                parameters[name] = float(text)
        listed: Edges = listed_edges(table, len(self._nodes))
        return {"edges": listed} | ({"parameters": parameters} if parameters else {})

    @staticmethod
    def _refuse_type(*_: object) -> None:
        raise ValueError("expected no document type, which could declare entities, got one; remove <!DOCTYPE ...>")

    def _start(self, element: str, attributes: dict[str, str]) -> None:
        name = element.rpartition(" ")[2]
        self._path.append(name)
        match name:
            case "graph":
                if self._has_graph:  # at once: a document may have a million
                    raise ValueError("expected one graph, got more")
                self._has_graph = True
                if attributes["edgedefault"] != "undirected":
                    raise ValueError(
                        'expected edgedefault="undirected", as a spring pulls both its blocks, got a directed graph'
                    )
            case "key":
                self._keys[attributes["id"]] = attributes.get("attr.name", "")
                self._key = attributes["id"]
            case "node":
                if attributes["id"] in self._nodes:
                    raise ValueError(f"expected each node once, got {attributes['id']!r} twice")
                self._nodes[attributes["id"]] = len(self._nodes)
            case "edge":
                if attributes.get("directed", "false") != "false":
                    raise ValueError("expected undirected edges, got a directed one")
                self._ends.append((attributes["source"], attributes["target"]))
                self._weights.append("")
            case "hyperedge":
                raise ValueError("expected edges between two nodes, got a hyperedge")
            case "data":
                self._key = attributes["key"]
        self._text.clear()

    def _end(self, _: str) -> None:
        name, place = self._path.pop(), self._path[-1] if self._path else ""
        attribute, text = self._keys.get(self._key, ""), "".join(self._text).strip()
        match place, name:
            case ("edge", "data") if attribute == "weight":
                self._weights[-1] = text
            case ("edge", "data") | ("node", "data"):
                pass
            case ("key", "default") if attribute == "weight":
                self._weight = text
            case ("graph", "data"):
                self._numbers[attribute] = text
            case (_, "graphml"):
                self._weights = [weight or self._weight for weight in self._weights]
        self._text.clear()
