"""The guide's notebook, in a real kernel."""

from __future__ import annotations

import re
from pathlib import Path

import nbclient
import nbformat
import pytest

from stickslip import Dataset
from stickslip.pipeline import QueryError, verify

pytestmark = pytest.mark.long  # a kernel of its own, and workers
PAGE = (Path(__file__).parents[2] / "docs" / "guide" / "python.md").read_text()
CELLS = re.findall(r"^```python\n(.*?)^```", PAGE, flags=re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """The page's cells as a notebook that was run, and its folder."""
    folder = tmp_path_factory.mktemp("notebook")
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in CELLS])
    nbclient.NotebookClient(notebook, timeout=500, resources={"metadata": {"path": str(folder)}}).execute()
    nbformat.write(notebook, folder / "notebook.ipynb")
    return notebook, folder


def shown(cell, kind):
    return "".join(output.data.get(kind, "") for output in cell.outputs if "data" in output)


def test_the_cells_show_what_the_page_says(done):
    notebook, folder = done
    about, run, query, _, more, _, alone, *pictures = notebook.cells
    assert shown(about, "text/plain") == "('2 belt_speed x 3 draws of the start', 24)"
    assert shown(run, "text/plain").splitlines()[0] == "belt_speed"
    assert "<table" in shown(query, "text/html")
    assert shown(more, "text/plain") == "36"
    assert "data:image/png;base64," in shown(alone, "text/html")
    assert [len(re.findall("image/png", str(cell.outputs))) for cell in pictures] == [1, 3, 1]
    dataset = Dataset(folder / "runs" / "belt")
    assert (len(dataset.members), verify(dataset.path)) == (36, [])
    assert (folder / "runs" / "belt" / "report.html").exists()
    last = dataset.members.iloc[-1]
    assert len(dataset.member(last["member_id"]).simulate().events) == last["n_events"]
    with pytest.raises(QueryError, match=r"member_id: expected a member of the scene, got 'm0'"):
        dataset.member("m0")


def test_a_bar_is_shown_and_nothing_else(done):
    said = "".join(one.text for cell in done[0].cells for one in cell.outputs if one.output_type == "stream")
    assert "24/24 members" in said
    assert "questions" in said
    assert "Traceback" not in said
    assert "Warning" not in said
