"""All changes of a study are one question: what leads, one table, and its figures."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis import Study, build
from stickslip.analysis.findings.finding import Change, Lack, Outcomes, Reason
from stickslip.analysis.findings.words import sentence
from stickslip.analysis.questions import refuse_unknown, renamed
from stickslip.analysis.questions.runs.changes import answer
from tests.analysis.designs import Data

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture
def both(planted):
    """Two engines at two speeds, at one of which n_stick is higher by 20; the sigmoid is lower by 5 throughout."""

    def make(n_matrices=8, engines=("coulomb", "sigmoid"), speeds=(-0.1, -0.2)):
        rows, series = [], {}
        for engine in engines:
            for matrix in range(n_matrices):
                t, n_stick = planted.runs(np.random.default_rng(matrix), 600, 0.69)
                for v in speeds:
                    name = f"{engine}{v}-{matrix}"
                    own = planted.sigmoid if engine == "sigmoid" else {}
                    rows.append(planted.member(name, matrix, belt_speed=v, **own))
                    shift = 20 * (v == -0.1) - 5 * (engine == "sigmoid") + matrix % 2
                    series[name] = t, n_stick - n_stick.min() + 40 + shift
        return Data(pd.DataFrame(rows), series)

    return make


def test_the_change_along_the_key_leads_and_then_that_between_engines(both, settings):
    found = answer(Study(both(), replace(settings, margins={"mean": 0.02})))
    lead = found.findings[: found.n_lead]
    assert [type(one) for one in lead] == [Change, Change, Outcomes]
    assert all(len(sentence(one).split()) <= 40 for one in lead)
    assert lead[-1].different == ("sigmoid",)
    assert set(found.tables["changes"]["kind"]) == {"key", "law"}
    assert list(found.figures)[:2] == ["sweep_mean", "contrasts"]


def test_what_does_not_differ_is_not_asked_and_what_cannot_be_told_stands_last(both, settings):
    assert answer(Study(both(engines=("coulomb",), speeds=(-0.1,)), settings)) is None
    (lack,) = answer(Study(both(1, speeds=(-0.1,)), settings)).findings[:1]
    assert not isinstance(lack, Lack) or lack.reason is Reason.FEW_UNITS


def test_old_names_are_read(both, settings):
    assert renamed(("sweep", "engines", "robustness")) == ("changes",)
    refuse_unknown(("sweep", "engines", "robustness", "changes"))
    report = build(both(), replace(settings, question=("changes",)), "T", "", {})
    assert report.headline[1].startswith("Mean number of sticking blocks rises from ")
    assert "What changes, and by how much?" in report.html
