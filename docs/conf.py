"""How the guide is built: `sphinx-build -n -W -b html docs docs/_build`."""

from __future__ import annotations

import pydoc
import re
import sys
from collections.abc import Iterable
from pathlib import Path

import pyarrow as pa
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

sys.path.insert(0, str(Path(__file__).parents[1]))

from stickslip.pipeline.dataset.schema import as_fields
from stickslip.pipeline.records import RECORDS
from stickslip.pipeline.scene.columns import FIXED, ON_DEMAND
from stickslip.workflows.scaffold import key_tables

project = "stickslip"
copyright = "the authors of stickslip"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]

html_theme = "furo"
html_title = "stickslip"
html_copy_source = False
html_show_sourcelink = False

myst_enable_extensions = ["deflist"]
myst_heading_anchors = 3
smartquotes = False  # s'' is a derivative

default_role = "py:obj"
nitpick_ignore = [("py:obj", "Axes.step")]  # of matplotlib
nitpick_ignore_regex = [("py:class", r"stickslip\.sim\.systems\.weakening\..*\.kind")]  # made for each law
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say what is taken, with shapes
napoleon_google_docstring = False
napoleon_use_param = False  # as words: "float or array_like, shape (n,)" is no name to look up
napoleon_use_rtype = False
napoleon_custom_sections = [("Attributes", "params_style")]

#: Stands for a colon in the docstring of a plain value, where napoleon would take what is before it for a type.
_COLON = "\ue000"
_VALUES = ("attribute", "data", "property")
_SECTIONS = {"Parameters", "Attributes", "Returns", "Yields", "Raises", "Notes"}


def _as_written(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Formulas as they stand: |x| is a magnitude, and what is set off by indentation is set as it is."""
    found: list[str] = []
    is_formula = in_section = False
    for line in lines:
        text = line.strip()
        in_section = in_section or text in _SECTIONS
        is_set_off = line.startswith("    ") and not in_section
        if is_set_off and not is_formula and found and not found[-1].strip():
            found += ["::", ""]
            is_formula = True
        is_formula = is_formula and (is_set_off or not text)
        found.append(line if is_formula else _without_substitutions(line))
    lines[:] = [line.replace(":", _COLON) for line in found] if what in _VALUES else found


def _without_substitutions(line: str) -> str:
    parts = re.split(r"(``.*?``)", line)
    return "".join(part if part.startswith("``") else part.replace("|", "\\|") for part in parts)


def _with_colons(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    lines[:] = [line.replace(_COLON, ":") for line in lines]


def _known_elsewhere(app: Sphinx, env: object, node: nodes.Element, content: nodes.Node) -> nodes.Node | None:
    """A name in a docstring that has no page: an argument, or what the code can import; else the build warns."""
    target = node.get("reftarget", "")
    if node.get("refdomain") != "py" or node.get("reftype") not in ("obj", "exc"):
        return None
    owner, _, name = target.rpartition(".")
    found = [pydoc.locate(f"{prefix}{owner}") for prefix in ("", "stickslip.", f"{node.get('py:module')}.")]
    is_known = not owner or any(hasattr(o, name) or name in getattr(o, "__annotations__", ()) for o in found if o)
    return content if is_known else None


class SceneKeys(SphinxDirective):
    """Every table of a scene with its keys, from the schema."""

    def run(self) -> list[nodes.Node]:
        text = []
        for table, about, keys in key_tables(None):
            head = [f"`{table}`", f": {about}"] if table else ["Above all tables:"]
            text += ["", *head, "", "| key | what | values | default |", "|---|---|---|---|"]
            for key in keys:
                row = f"| `{key.path.rpartition('.')[2]}` | {key.meaning} | {key.values} | {key.default} |"
                text.append(row.replace("|w - v|", r"\|w - v\|"))
        return self.parse_text_to_nodes("\n".join(text))


class Columns(SphinxDirective):
    """Every column that a dataset may have, from the fields of its schema."""

    def run(self) -> list[nodes.Node]:
        text = _columns("In every dataset:", as_fields(FIXED))
        for name, (asked_by, columns) in ON_DEMAND.items():
            text += _columns(f"With {asked_by}{_added(name)}{':' if columns else '.'}", as_fields(columns))
        return self.parse_text_to_nodes("\n".join(text))


def _added(name: str) -> str:
    """What a finished dataset has to keep so that a record is added to it and nothing is run."""
    needs = next((record.needs for record in RECORDS if record.name == name), {"run"})
    kept = " and ".join(f"`{one}`" for one in sorted(needs - {"system"}))
    if "run" in needs:
        return ""
    of = f" where there are {kept}" if kept else ""
    return f", which is [added](scenes.md#adding-to-a-finished-dataset) without a run{of}"


def _columns(head: str, fields: Iterable[pa.Field]) -> list[str]:
    rows = [
        f"| `{field.name}` | {_kind(field.type)} | {field.metadata[b'description'].decode()} |".replace(
            "|w - v|", r"\|w - v\|"
        )
        for field in fields
    ]
    return ["", head, *(["", "| column | type | what |", "|---|---|---|", *rows] if rows else [])]


def _kind(kind: pa.DataType) -> str:
    if pa.types.is_list(kind):
        return f"list of {_kind(kind.value_type)}"
    if pa.types.is_struct(kind):
        return ", ".join(f"{part.name} {_kind(part.type)}" for part in kind)
    return "float64" if pa.types.is_float64(kind) else str(kind)


def setup(app: Sphinx) -> None:
    app.add_directive("scene-keys", SceneKeys)
    app.add_directive("columns", Columns)
    app.connect("autodoc-process-docstring", _as_written, priority=400)  # before napoleon
    app.connect("autodoc-process-docstring", _with_colons, priority=600)  # after it
    app.connect("missing-reference", _known_elsewhere)
