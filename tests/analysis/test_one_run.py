"""The picture of one run on a report: which run, what it counts, and when nobody asked for it."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis import Data, Study, build
from stickslip.analysis.questions.runs.one_run import MOST_MEMBERS, answer
from stickslip.analysis.report.formats import environment
from stickslip.analysis.report.page import ask

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
    facts = answer(study()).facts
    assert facts["run"] == "m2"
    assert facts["events"] == {"n_exits": 2, "n_never": 2, "block": 0, "of_block": 2}
    assert facts["sticks"] == pytest.approx((3 + 2 * 2 + 3 + 2) / (4 * 5))
    said = environment().get_template("one_run.html").module.answer(facts)
    assert " ".join(said.split()) == (
        "In one run of 4 blocks to t = 5, blocks let go 2 times, block 0 most often (2); 2 of 4 never slip."
    )


def test_a_run_that_ran_away_is_drawn_as_far_as_it_went(study):
    found = answer(study(n_members=2))
    assert (found.facts["run"], found.facts["t_end"], found.facts["is_finished"]) == ("m1", 4.5, False)
    (ax,) = found.figures["one_run"]().axes
    assert ax.get_xlim() == (0.0, 4.5)


def test_it_is_left_out_unless_few_runs_record_events_or_it_is_asked(study):
    assert answer(study(n_members=MOST_MEMBERS)) is not None
    assert answer(study(n_members=MOST_MEMBERS + 1)) is None
    assert answer(study(events=False)) is None
    assert answer(study(n_members=MOST_MEMBERS + 1, question=("one_run",))) is not None


def test_without_events_it_is_the_series(study):
    found = answer(study(events=False, question=("one_run",)))
    (ax,) = found.figures["one_run"]().axes
    t, n_stick = ax.lines[0].get_data()
    assert (t.tolist(), n_stick.tolist()) == ([0, 1, 3, 4, 5], [3, 2, 3, 2, 2])
    assert (found.facts["least"], found.facts["most"], found.facts["events"]) == (2, 3, None)


def test_where_no_run_was_completed_it_says_so(study):
    assert answer(study(n_members=2, question=("one_run",))).lack == ""
    only = study(n_members=2)
    only = replace(only, data=replace(only.data, table=only.data.members.assign(outcome="failed")))
    assert answer(only).lack == "none ran"


def test_the_largest_episode_after_burning_in_is_drawn_beside(study):
    columns = ("member_id", "start", "end", "size", "moment")
    rows = [
        ("m2", 0.2, 0.6, 4, 9.0), ("m2", 1.0, 2.0, 2, -3.0), ("m2", 2.2, 2.4, 2, 1.0), ("m2", 2.3, 4.9, 4, 7.0),
        ("m2", 3.0, 3.1, 1, 8.0), ("m1", 1.0, 1.5, 3, 5.0),
    ]  # fmt: skip
    found = answer(study(episodes=pd.DataFrame(rows, columns=columns)))
    assert found.facts["episode"] == {"start": 1.0, "end": 2.0, "size": 2, "moment": -3.0, "span": (0.9, 2.1)}
    (ax,) = found.figures["one_episode"]().axes
    assert ax.get_xlim() == (0.9, 2.1)


def test_a_grid_is_drawn_in_rows(study):
    (ax,) = answer(study(coupling="grid")).figures["one_run"]().axes
    assert ax.get_ylabel() == "row of the grid, 2 blocks each"


@pytest.mark.parametrize("events", [True, False])
def test_the_page_shows_it_and_is_the_same_twice(study, events):
    asked = study(events=events, question=("one_run",))
    pages = {build(asked.data, asked.settings, "T", "", {}).html for _ in range(2)}
    assert len(pages) == 1
    assert pages.pop().count("which block slips when" if events else "n_stick against time, in one run") >= 1
    assert ask(asked, "one_run").figures["one_run"].svg.startswith("<?xml")
