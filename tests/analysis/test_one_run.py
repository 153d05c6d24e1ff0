"""The picture of one run on a report: which run, what it counts, and when nobody asked for it."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis import Study, build
from stickslip.analysis.findings.finding import Lack, Reason
from stickslip.analysis.findings.words import sentence
from stickslip.analysis.page.parts import ask
from stickslip.analysis.questions.runs.one_run import MOST_MEMBERS, answer
from tests.analysis.designs import Data

#: Four blocks: 0 lets go at 1, sticks at 3, lets go at 4; 1 slips throughout; 2 and 3 never do.
EVENTS = (
    np.array([1.0, 3.0, 4.0]), np.zeros(3, np.int32), np.array([1, 0, -1], np.int8), np.array([0, -1, 0, 0], np.int8),
)  # fmt: skip

SERIES = (np.array([0.0, 1.0, 3.0, 4.0]), np.array([3, 2, 3, 2]))


@pytest.fixture
def study(planted, settings):
    def of(n_members=3, events=True, question=(), episodes=None, **changes):
        rows = [planted.member(f"m{k}", k, n=4, t_end=5.0, t_stop=5.0, **changes) for k in range(n_members)]
        rows[0] |= {"outcome": "failed", "reason": "planted"}
        rows[1] |= {"outcome": "diverged", "t_stop": 4.5}
        done = [row["member_id"] for row in rows[1:]]
        data = Data(
            pd.DataFrame(rows), dict.fromkeys(done, SERIES), dict.fromkeys(done, EVENTS) if events else {},
            episodes=episodes,
        )  # fmt: skip
        return Study(data, replace(settings, t_burn=0.5, question=question))

    return of


def test_it_counts_the_first_run_that_finished(study):
    found = answer(study())
    onsets, slipping, sticking = found.findings
    assert onsets.estimate.value == 2
    assert slipping.estimate.value == 0.5
    assert sticking.estimate.value == pytest.approx((3 + 2 * 2 + 3 + 2) / (4 * 5))
    assert sentence(onsets) == "Number of slip onsets, one run of 4 blocks from t = 0 to 5: 2."
    assert "Run m2 is the first of 3 that finished" in found.method


def test_a_run_that_grew_without_limit_is_drawn_as_far_as_it_went(study):
    found = answer(study(n_members=2))
    assert "Run m1 is the first of 2 that was begun" in found.method
    assert str(found.findings[0].where) == "one run of 4 blocks from t = 0 to 4.5"
    (ax,) = found.figures["one_run"].recipe().axes
    assert ax.get_xlim() == (0.0, 4.5)


def test_it_is_left_out_unless_few_runs_record_events_or_it_is_asked(study):
    assert answer(study(n_members=MOST_MEMBERS)) is not None
    assert answer(study(n_members=MOST_MEMBERS + 1)) is None
    assert answer(study(events=False)) is None
    assert answer(study(n_members=MOST_MEMBERS + 1, question=("one_run",))) is not None


def test_without_events_it_is_the_series(study):
    found = answer(study(events=False, question=("one_run",)))
    (ax,) = found.figures["one_run"].recipe().axes
    t, n_stick = ax.lines[0].get_data()
    assert (t.tolist(), n_stick.tolist()) == ([0, 1, 3, 4, 5], [3, 2, 3, 2, 2])
    assert [finding.quantity.key for finding in found.findings] == ["stick_share"]


def test_where_all_runs_failed_it_says_so(study):
    only = study(n_members=2)
    only = replace(only, data=replace(only.data, table=only.data.members.assign(outcome="failed")))
    assert answer(only).findings == [Lack("the picture of a run", Reason.ALL_FAILED)]


def test_a_grid_is_drawn_in_rows(study):
    (ax,) = answer(study(coupling="grid")).figures["one_run"].recipe().axes
    assert ax.get_ylabel() == "row of the grid, 2 blocks each"


@pytest.mark.parametrize("events", [True, False])
def test_the_page_shows_it_and_is_the_same_twice(study, events):
    asked = study(events=events, question=("one_run",))
    pages = {build(asked.data, asked.settings, "T", "", {}).html for _ in range(2)}
    assert len(pages) == 1
    page = pages.pop()
    assert ("Which block slips when" if events else "Number of sticking blocks") in page
    assert "one run of 4 blocks from t = 0 to 5" in page
    assert ask(asked, "one_run").figures["one_run"].svg.startswith("<?xml")
