"""A table of objects has a column a field, three of an estimate, and a null for what is missing."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, NamedTuple

from stickslip.analysis.rows import frame_of
from stickslip.analysis.stats.estimates import Estimate


class Verdict(StrEnum):
    MORE = "more"


class Pair(NamedTuple):
    key: str
    value: float | None


@dataclass(frozen=True)
class Row:
    name: str
    n: int | None
    share: Estimate
    is_known: bool
    verdict: Verdict | None = None


def test_a_column_a_field():
    table = frame_of(
        Row, [Row("a", 3, Estimate(0.5, 0.25, 0.75), True, Verdict.MORE), Row("", None, Estimate(), False)]
    )
    assert table.dtypes.astype(str).to_dict() == {
        "name": "string", "n": "Int64", "share": "Float64", "share_low": "Float64", "share_high": "Float64",
        "is_known": "boolean", "verdict": "string",
    }  # fmt: skip
    assert table.iloc[0].to_list() == ["a", 3, 0.5, 0.25, 0.75, True, "more"]
    assert table.iloc[1].isna().to_list() == [True, True, True, True, True, False, True]


def test_named_tuples_too_and_no_row_has_all_columns():
    assert frame_of(Pair, []).columns.to_list() == ["key", "value"]
    assert frame_of(Pair, [Pair("a", None)])["value"].isna().all()


class Counted(NamedTuple):
    law: Literal["exact", "smoothed"] | None
    counts: list[int]


def test_a_choice_is_a_text_and_a_list_stays_one():
    table = frame_of(Counted, [Counted("exact", [3, 1]), Counted(None, [])])
    assert table.dtypes.astype(str).to_dict() == {"law": "string", "counts": "object"}
    assert table["law"].isna().to_list() == [False, True]
    assert table["counts"].to_list() == [[3, 1], []]
