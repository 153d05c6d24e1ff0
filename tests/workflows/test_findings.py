"""The findings of a report from Python: as the page and its JSON have them; refused where they are not whole."""

import html
import json
import shutil

import pytest

from stickslip import Dataset
from stickslip.pipeline import StoreError

FILE = "report/findings.json"


@pytest.fixture
def copied(dataset, tmp_path):
    shutil.copytree(dataset, tmp_path / "copy")
    return tmp_path / "copy"


def test_a_frame_has_what_the_page_says(dataset):
    told = json.loads((dataset / FILE).read_text())["findings"]
    page = html.unescape((dataset / "report.html").read_text())
    table = Dataset(dataset).findings()
    assert len(table) == sum(max(len(finding["rows"]), 1) for finding in told)
    assert set(table["sentence"]) == {finding["sentence"] for finding in told}
    assert 1 <= sum(finding["leads"] for finding in told) <= 3
    first = next(finding for finding in told if finding["leads"])
    assert f'<p class="lead">{first["sentence"]}' in page
    known = table.dropna(subset=["low", "high"])
    assert (known["low"] <= known["high"]).all()
    assert set(table["question"]) <= {finding["question"] for finding in told}


@pytest.mark.parametrize(
    "damage", ["[]", "{}", '{"findings": [1]}', '{"findings": [{"rows": 3}]}', "\xff", "[" * 200_000]
)
def test_a_damaged_file_is_refused_by_name(copied, damage):
    (copied / FILE).write_bytes(damage.encode("latin-1"))
    with pytest.raises(StoreError, match=r"findings\.json is damaged"):
        Dataset(copied).findings()


def test_without_a_report_the_error_says_what_to_do(copied):
    (copied / FILE).unlink()
    with pytest.raises(StoreError, match="stickslip report"):
        Dataset(copied).findings()
