"""The rule by which claims are judged."""

from stickslip.workflows.gallery.charts.claims import every, share, told


def test_a_claim_is_told_where_its_whole_interval_is():
    assert told(0.51, 0.9, 0.5) == "reproduced"
    assert told(0.4, 0.9, 0.5) == "cannot be told"
    assert told(0.1, 0.4, 0.5) == "not reproduced"
    assert told(0.1, 0.4, 0.5, otherwise="corrected") == "corrected"
    assert told(None, 0.4, 0.5) == "cannot be told"


def test_of_claims_that_all_have_to_hold_the_worst_verdict_counts():
    assert every(["reproduced", "reproduced"]) == "reproduced"
    assert every(["reproduced", "cannot be told", "corrected"]) == "corrected"
    assert every(["corrected", "not reproduced"]) == "not reproduced"


def test_a_share_of_none_has_no_interval():
    assert share(0, 0) == {"found": 0, "tried": 0, "low": None, "high": None}
    assert share(3, 3)["high"] == 1.0
