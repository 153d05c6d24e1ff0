"""What the independent units of a group are: matrices, starts of one system, or files; the interval is over these."""

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis import Study, build
from stickslip.analysis.members import FILE, MATRIX, POINT, START, Members
from stickslip.analysis.stats import student
from stickslip.pipeline.design.values import rank
from tests.analysis.designs import Data, members


def runs_of(planted, rng, systems, n_starts, unit=None):
    """A run for each start of each system (file, matrix), at levels that differ between systems and starts."""
    rows, series = [], {}
    for file, matrix in systems:
        level = 300 + round(20 * rng.standard_normal())
        for start in range(n_starts):
            name = f"{file}-{matrix}-{start}"
            given = {"file": file, "start_draw": start if n_starts > 1 else None}
            rows.append(planted.member(name, matrix, **given))
            series[name] = planted.runs(rng, 400, 0.7, level=level + rng.integers(5))
    return Data(members(pd.DataFrame(rows), unit), series)


@pytest.mark.parametrize(("systems", "n_starts", "unit", "n_units"), [
    ([(None, m) for m in range(6)], 1, MATRIX, 6),
    ([(None, m) for m in range(6)], 5, MATRIX, 6),
    ([(None, 0)], 30, START, 30),
    ([("K.npz", 77)], 30, START, 30),
    ([("K.npz", m) for m in (9, 4, 7)], 5, MATRIX, 3),
    ([(f"K{m}.npz", m) for m in range(6)], 1, FILE, 6),
])  # fmt: skip
def test_the_interval_is_over_the_units(planted, settings, rng, systems, n_starts, unit, n_units):
    data = runs_of(planted, rng, systems, n_starts, unit)
    (group,) = Study(data, settings).groups
    assert (group.unit, len(group.units)) == (unit, n_units)
    of_run = pd.Series({
        name: window.time_mean() for _, name, window in Study(data, settings).windows(group)
    })  # fmt: skip
    by = of_run.groupby(lambda name: name if unit == START else name.rpartition("-")[0]).mean()
    half = student.half_width(0.95, n_units - 1) * by.std() / np.sqrt(n_units)
    mean = group.mean(0.95)
    assert (mean.value, mean.low, mean.high) == pytest.approx((by.mean(), by.mean() - half, by.mean() + half))


def test_files_with_several_starts_are_kept_apart(planted, settings, rng):
    data = runs_of(planted, rng, [("a.npz", 5), ("b.npz", 8)], 12, START)
    found = Study(data, settings).groups
    assert [(group.key["file"], group.unit, len(group.units)) for group in found] == [
        ("a.npz", START, 12),
        ("b.npz", START, 12),
    ]
    assert ["file = a.npz" in found[0].label, "file = b.npz" in found[1].label] == [True, True]


def test_a_start_that_is_not_drawn_is_one_run_of_its_matrix(planted, settings, rng):
    drawn = runs_of(planted, rng, [(None, 0)], 8)
    fixed = planted.member("fixed", 0, z0=-0.7, start_draw=None)
    data = Data(
        pd.concat([drawn.members, pd.DataFrame([fixed])]), dict(drawn.series) | {"fixed": planted.runs(rng, 400, 0.7)}
    )
    assert sorted((group.unit, len(group.units)) for group in Study(data, settings).groups) == [
        (MATRIX, 1),
        (START, 8),
    ]


def test_the_page_says_what_the_units_are(planted, settings, rng, monkeypatch):
    from stickslip.analysis.page import parts

    monkeypatch.setattr(parts, "draw", lambda *_, **__: parts.Drawn("<svg/>"))
    one_system = build(runs_of(planted, rng, [(None, 0)], 20), settings, "Starts", "", {})
    text = one_system.html.partition("</style>")[2]
    assert "over starts of this system" in text
    assert one_system.tables["groups"]["starts"].tolist() == [20]
    several = build(runs_of(planted, rng, [(None, m) for m in range(5)], 4), settings, "Both", "", {})
    assert "over independent systems" in several.html


def test_settings_are_in_the_order_of_their_values():
    """As text, 1e-05 comes after 0.0001, and 10 before 9."""
    values = [None, "uniform", 10, 9.0, 1e-05, 0.0001, -1.0]
    assert sorted(values, key=rank) == [-1.0, 1e-05, 0.0001, 9.0, 10, None, "uniform"]


def test_the_table_of_all_members_makes_the_same_members(planted):
    """Whether in one part or in several."""
    drawn, _ = planted.ensemble({"coulomb": 0.69, "sigmoid": 0.5}, 6)
    table = pd.DataFrame(drawn).assign(seed=[0, 1] * (len(drawn) // 2))
    whole = members(table)
    table = whole.together.assign(**{name: [whole.settings[k][name] for k in whole.own["setting"]] for name in POINT})
    parts = Members.of((table.iloc[k : k + 5] for k in range(0, len(table), 5)), whole.design)
    assert whole.together.columns.is_unique
    pd.testing.assert_frame_equal(parts.together[list(whole.together)], whole.together, check_dtype=False)
    assert sorted(map(str, parts.settings)) == sorted(map(str, whole.settings))
