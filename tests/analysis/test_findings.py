"""What a finding comes to: its verdict from the interval alone, its sentence, its row, and the digits of numbers."""

import re
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest

from stickslip.analysis.answer import Answer
from stickslip.analysis.findings.finding import (
    Alike,
    Attracting,
    Basis,
    Bound,
    Change,
    Comparison,
    Course,
    Decided,
    Difference,
    Family,
    Fit,
    Form,
    KeyChange,
    Lack,
    Law,
    Level,
    Lifetime,
    Outcomes,
    Parts,
    Quantity,
    Reason,
    Regime,
    Scale,
    Share,
    Threshold,
    Truth,
    Turn,
    Verdict,
    levels,
)
from stickslip.analysis.findings.numbers import limit, number, span, with_interval
from stickslip.analysis.findings.place import EVERYWHERE, Place
from stickslip.analysis.findings.words import capital, place_of, sentence
from stickslip.analysis.page.layout import findings_table
from stickslip.analysis.page.parts import Part, findings_json
from stickslip.analysis.page.parts import row as row_of
from stickslip.analysis.questions.runs import settled
from stickslip.analysis.stats.estimates import Estimate

GAMMA = Quantity("gamma", "decay rate")
SHARE = Quantity("share", "share of runs in motion", Form.SHARE)
NANO = " \u00d7 10\u207b\u2079"
KAPPA = (KeyChange("kappa", "0.1", "0.4"),)
LATE = Quantity("lifetime", "median lifetime", more="longer", less="shorter")


@pytest.mark.parametrize(("low", "high", "margin", "verdict"), [
    (0.006, 0.013, None, Verdict.MORE),
    (-0.013, -0.006, None, Verdict.LESS),
    (-0.001, 0.013, None, Verdict.OPEN),
    (0.006, 0.013, 0.05, Verdict.EQUAL),
    (-0.001, 0.06, 0.05, Verdict.OPEN),
    (0.01, 0.06, 0.05, Verdict.MORE),
    (-0.06, 0.001, 0.05, Verdict.OPEN),
    (None, None, 0.05, Verdict.UNJUDGED),
])  # fmt: skip
def test_the_interval_decides(low, high, margin, verdict):
    middle = None if low is None else (low + high) / 2
    assert Difference(Estimate(middle, low, high), margin=margin).verdict is verdict


def test_one_of_many_comparisons_needs_an_adjusted_p_value_too():
    shown = Estimate(0.02, 0.01, 0.03)
    assert Difference(shown, family=Family(7, 0.2)).verdict is Verdict.OPEN_AMONG_MANY
    assert Difference(shown, family=Family(7, 0.01)).verdict is Verdict.MORE
    assert Difference(shown, margin=0.05, family=Family(7, 0.2)).verdict is Verdict.EQUAL


@pytest.mark.parametrize(
    ("estimate", "form", "text"),
    [
        (Estimate(0.7004, 0.6971, 0.7022), Form.NUMBER, "0.7004 (0.6971 to 0.7022)"),
        (Estimate(0.3008, 0.288, 0.314), Form.SHARE, "30.1% (28.8 to 31.4%)"),
        (Estimate(206.3, 150.0, 290.0), Form.NUMBER, "206 (150 to 290)"),
        (Estimate(0.0, 0.0, 0.161), Form.SHARE, "0.0% (0.0 to 16.1%)"),
        (Estimate(3.508), Form.NUMBER, "3.51"),
        (Estimate(2.0), Form.COUNT, "2"),
        (Estimate(206.0, 150.0), Form.NUMBER, "206 (at least 150)"),
        (Estimate(-0.013, -0.02, -0.006), Form.NUMBER, "\u22120.0130 (\u22120.0200 to \u22120.0060)"),
        (Estimate(12345.0, 12000.0, 12700.0), Form.NUMBER, "12,345 (12,000 to 12,700)"),
        (Estimate(3e-9, 2e-9, 4e-9), Form.NUMBER, f"3.0{NANO} (2.0{NANO} to 4.0{NANO})"),
        (Estimate(2.5e90), Form.NUMBER, "2.50 \u00d7 10\u2079\u2070"),
    ],
)  # fmt: skip
def test_numbers_have_two_digits_of_their_interval(estimate, form, text):
    assert with_interval(estimate, form) == text


@pytest.mark.parametrize(
    ("most", "form", "text"),
    [
        (0.00281, Form.SHARE, "0.29%"),
        (0.0028, Form.SHARE, "0.28%"),
        (0.3, Form.SHARE, "30%"),
        (0.0, Form.SHARE, "0%"),
    ],
)
def test_a_limit_is_rounded_up(most, form, text):
    assert limit(most, form) == text


def test_different_ends_never_look_alike(rng):
    for _ in range(300):
        value = rng.choice([-1, 1]) * 10.0 ** rng.uniform(-12, 9)
        half = abs(value) * 10.0 ** rng.uniform(-6, 1)
        for form in Form:
            first, second = span(value - half, value + half, form).split(" to ")
            assert first.rstrip("%") != second.rstrip("%")
            assert number(-0.0, form, 2) == number(0.0, form, 2)


def test_sentences():
    ratio = Difference(Estimate(0.0095, 0.0061, 0.0131))
    law = Level(GAMMA, Estimate(0.6998, 0.697, 0.7022), comparison=Comparison("a fair coin's ln 2", ratio))
    assert sentence(law) == "Decay rate: 0.6998 (0.6970 to 0.7022), 0.95% (0.61 to 1.31%) above a fair coin's ln 2."
    assert sentence(Law("cascade sizes", "fall off exponentially", law)) == (
        "Cascade sizes fall off exponentially: decay rate 0.6998 (0.6970 to 0.7022), "
        "0.95% (0.61 to 1.31%) above a fair coin's ln 2."
    )
    often = Comparison("shifted blocks", Difference(Estimate(10.4, 4.84, 21.3)))
    assert sentence(Level(GAMMA, Estimate(6.6), comparison=often)) == (
        "Decay rate: 6.60, 11.4 (5.8 to 22.3) times that of shifted blocks."
    )
    away = Difference(Estimate(-0.3, -0.4, -0.2), Scale.ABSOLUTE)
    turn = Turn(Course.MINIMUM, Estimate(9.05, 8.85, 9.25), Place.key("kappa", "0.2"))
    turned = Change(
        LATE, KAPPA, Estimate(16.4), Estimate(10.63), Difference(Estimate(-0.35, -0.4, -0.3)), turns=(turn,)
    )
    assert sentence(turned) == (
        "Median lifetime has a minimum of 9.05 (8.85 to 9.25) near kappa = 0.2. It falls from 16.4 and rises to 10.6"
        " as kappa goes from 0.1 to 0.4."
    )
    peak = Turn(Course.MAXIMUM, Estimate(12.0, 11.8, 12.2), Place.key("kappa", "0.3"))
    assert sentence(replace(turned, turns=(turn, peak))) == (
        "Median lifetime has a minimum near kappa = 0.2 and a maximum near 0.3. It goes from 16.4"
        " through 9.05 (8.85 to 9.25) and 12.00 (11.80 to 12.20) to 10.6 as kappa goes from 0.1 to 0.4."
    )
    assert sentence(replace(turned, turns=4 * (turn,))).startswith("Median lifetime turns 4 times as kappa goes from")
    gone = Change(SHARE, KAPPA, Estimate(0.5), Estimate(0.2), away, Place.key("eps", "0.03"))
    assert sentence(gone) == (
        "Share of runs in motion falls from 50% to 20%, by 30 (20 to 40) percentage points, "
        "as kappa goes from 0.1 to 0.4. Setting: eps = 0.03."
    )
    lifetime = Lifetime(LATE, Estimate(206.0, 150.0, 290.0), Place.key("n", "100"))
    assert sentence(lifetime) == "Median lifetime at n = 100: 206 (150 to 290)."
    basin = Share("sliding", "starts", "end in steady sliding", Estimate(0.301, 0.288, 0.314))
    assert sentence(basin) == "30.1% (28.8 to 31.4%) of starts end in steady sliding."
    published = Comparison("the published 30.71%", Difference(Estimate(-0.006, -0.019, 0.007), Scale.ABSOLUTE))
    assert sentence(replace(basin, comparison=published)) == (
        f"{sentence(basin)[:-1]}, consistent with the published 30.71%;"
        " the difference is \u22120.6 (\u22121.9 to +0.7) percentage points."
    )
    excess = Quantity("excess", "excess", Form.SHARE)
    parts = [
        Level(Quantity(name, name), Estimate(*of))
        for name, of in (("noise", (-0.012, -0.014, -0.010)), ("pull", (0.021, 0.018, 0.024)))
    ]
    assert sentence(Parts(Level(excess, Estimate(0.009, 0.006, 0.012), Place.key("n", "5")), (*parts,))) == (
        "At n = 5, pull raises the excess by 2.10% (1.80 to 2.40%);"
        " noise adds \u22121.20% (\u22121.40 to \u22121.00%)."
    )
    parts.insert(1, Level(Quantity("size", "size"), Estimate(0.013, 0.011, 0.015)))
    assert sentence(Parts(Level(excess, Estimate(0.022, 0.019, 0.025)), (*parts,), "rate")) == (
        "Pull raises the rate by 2.10% (1.80 to 2.40%); noise adds \u22121.20% (\u22121.40 to \u22121.00%), size adds"
        " +1.30% (+1.10 to +1.50%)."
    )
    within = Comparison("the exact engine", Difference(Estimate(0.006, 0.004, 0.008), margin=0.01))
    assert sentence(Level(GAMMA, Estimate(0.7), comparison=within)) == (
        "Decay rate: 0.700, 0.60% (0.40 to 0.80%) above the exact engine, within the margin of 1%."
    )
    beside = Level(replace(GAMMA, clause="the decay rate is {}"), Estimate(0.7), comparison=within)
    assert (
        sentence(beside)
        == "The decay rate is 0.60% (0.40 to 0.80%) more than for the exact engine, within the margin of 1%."
    )
    around = Comparison("the exact engine", Difference(Estimate(0.006, -0.001, 0.008), margin=0.01))
    assert sentence(replace(beside, comparison=around)) == (
        "The decay rate is within 1% (\u22120.10 to +0.80%) of that for the exact engine."
    )
    small = Difference(Estimate(-0.0056, -0.009, -0.0023), margin=0.01)
    assert sentence(Change(GAMMA, KAPPA, Estimate(0.70273), Estimate(0.6988), small)) == (
        "Decay rate falls from 0.7027 to 0.6988, by 0.56% (0.23 to 0.90%), within the margin of 1%, as kappa goes"
        " from 0.1 to 0.4."
    )
    span = Level(Quantity("in_range", "share in the range of b", Form.SHARE), Estimate(0.0552))
    b = Level(Quantity("b", "b-value"), Estimate(0.879, 0.835, 0.924))
    assert sentence(Law("moments", "follow a power law", b, scope=span, things="episodes")) == (
        "Moments follow a power law (5.5% of episodes): b-value 0.879 (0.835 to 0.924)."
    )
    alike = Regime("slide", "starts", ("slide",), 5, 5, Estimate(1.0, 0.57, 1.0), Place.key("v", "1"))
    assert sentence(alike) == "At v = 1, all 5 starts (lower bound 57%) slide."
    some = replace(alike, predicates=("slide", "stick", "stop"), n=4, share=Estimate(0.8, 0.38, 0.96))
    assert sentence(some) == "At v = 1, 80% (38 to 96%) of 5 starts slide; the others stick or stop."
    assert sentence(replace(some, n=2, of=3, share=Estimate(2 / 3))) == (
        "At v = 1, 2 of 3 starts slide; the others stick or stop."
    )
    period = Quantity("period", "period of the cycle")
    assert sentence(Alike(period, 3.50812, "from all 8 starts")) == (
        "Period of the cycle: 3.508, the same from all 8 starts."
    )
    time = Quantity("stick_share", "mean share of time")
    assert sentence(Level(time, Estimate(0.0, 0.0, 0.0), basis=Basis(8))) == "Mean share of time: 0 in all 8 systems."
    assert sentence(Decided(Truth.NO, basin)) == f"No: {sentence(basin)}"


def test_no_difference_is_said_with_the_number_of_systems_where_intervals_are_wide():
    level = Level(SHARE, Estimate(0.25, 0.05, 0.7), comparison=Comparison("exact"), basis=Basis(4))
    wide = Difference(Estimate(0.25, -0.28, 0.7), Scale.ABSOLUTE)
    open_one = Outcomes("exact", undecided=("sigmoid",), largest=replace(level, comparison=Comparison("exact", wide)))
    there = replace(open_one, where=Place.key("n", "200"))
    assert sentence(there).startswith("At n = 200, no difference from exact is shown for sigmoid")
    assert sentence(open_one) == (
        "No difference from exact is shown for sigmoid (4 systems); largest difference +25 (\u221228 to +70)"
        " percentage points, in the share of runs in motion."
    )


@pytest.mark.parametrize(
    ("before", "after", "difference", "words"),
    [
        (19.7567, 18.9336, Estimate(-0.8231, -1.11, -0.54), "from 19.757 to 18.934, by 0.82 (0.54 to 1.11)"),
        (24.971, 23.473, Estimate(-1.498, -1.86, -1.14), "from 24.97 to 23.47, by 1.50 (1.14 to 1.86)"),
        (0.7482, 0.6913, Estimate(-0.0569, -0.07, -0.043), "from 0.748 to 0.691, by 0.057 (0.043 to 0.070)"),
    ],
)
def test_levels_have_the_difference_that_is_printed_beside_them(before, after, difference, words):
    change = Change(GAMMA, KAPPA, Estimate(before), Estimate(after), Difference(difference, Scale.ABSOLUTE))
    assert words in sentence(change)


def _pick(rng, kind):
    return [*kind][rng.integers(len(kind))]


def _differences(rng):
    value = rng.normal() * 10.0 ** rng.uniform(-3, 2)
    half = abs(value) * 10.0 ** rng.uniform(-1, 1)
    estimate = Estimate(value, value - half, value + half) if rng.random() < 0.8 else Estimate(value)
    family = Family(int(rng.integers(2, 30)), rng.random()) if rng.random() < 0.5 else None
    margin = abs(value) * rng.uniform(0.5, 20) if rng.random() < 0.5 else None
    return Difference(estimate, _pick(rng, Scale), margin, family, rng.random() < 0.1)


def _findings(rng):
    """One of each kind, at random."""
    difference = _differences(rng)
    quantity = [GAMMA, SHARE, LATE][rng.integers(3)]
    value = rng.uniform(0.0, 1.0)
    estimate = Estimate(value, value / 2, min(2 * value, 1.0))
    where = [EVERYWHERE, Place((("n", "100"), ("", "exact")))][rng.integers(2)]
    basis = [None, Basis(8), Basis(1, "start")][rng.integers(3)]
    comparison = [None, Comparison("the exact engine", difference)][rng.integers(2)]
    level = Level(quantity, estimate, where, comparison, basis)
    yield level
    yield Change(quantity, KAPPA, Estimate(0.3), estimate, difference, where, basis)
    yield (share := Share("sliding", "starts", "end in steady sliding", estimate, where, comparison, basis))
    yield Lifetime(LATE, estimate, where, comparison, basis)
    yield Law("sizes", "fall off exponentially", level, _pick(rng, Fit), level, scope=level, things="episodes")
    yield Parts(level, (level, level))
    yield Share("pairs", "exits", "trigger another", Estimate(high=value), where, basis=basis)
    yield Alike(quantity, value, "from all starts", where, basis)
    yield Outcomes("exact", ("h = 0.1",), ("h = 0.2", "h = 0.4"), (), level)
    yield Outcomes("exact", undecided=("h = 0.1",), largest=level, scope="the number of slip onsets")
    yield Outcomes("exact", ("h = 0.1",), largest=level)
    yield Threshold("stick-slip", bool(rng.integers(2)), "belt_speed", "0.3", "0.4", where, basis)
    yield Regime("slide", "starts", ("slide", "stick", "stop"), 9, 10, where=where)
    nouns = ("steady sliding", "stick-slip", "rest")[: rng.integers(1, 4)]
    yield Attracting(
        nouns, "belt_speed", "1", _pick(rng, ["1", "2"]), _pick(rng, Bound), _pick(rng, Bound), where, basis
    )
    for n in (1, 2, 4, 5):
        yield Regime("slide", "starts", ("slide",), n, 5, estimate, where, basis)
    yield Lack("the decay rate", _pick(rng, Reason), "12 cascades")
    yield Decided(_pick(rng, Truth), share)


def test_every_kind_is_a_sentence_and_rows(rng):
    kinds = set()
    for _ in range(40):
        for finding in _findings(rng):
            kinds.add(type(finding))
            said = sentence(finding)
            assert said.endswith(".")
            assert not said.endswith("..")
            assert "  " not in said
            assert not re.search(r"\bNone\b|\bnan\b|[A-Z]{2,}|\(\)|<|Verdict", said), said
            for row in map(row_of, levels(finding)):
                assert row.quantity
                assert row.low is None or row.high is None or row.low <= row.high
                assert row.verdict in {"", *Verdict}
                assert not any(isinstance(cell, float) and np.isnan(cell) for cell in row)
    assert len(kinds) == 13


#: What findings of the package are about, and where, the longest among them.
QUANTITIES = [
    measure
    for name in ("measures", "questions.slips.episodes", "questions.slips.cascades", "questions.runs.fates")
    for measure in vars(import_module(f"stickslip.analysis.{name}")).values()
    if isinstance(measure, Quantity)
]
PLACES = [
    EVERYWHERE,
    Place.key("n", "100"),
    Place(
        (("n", "100"), ("kappa", "0.2"), ("static", "uniform(1.1, 1.5) friction"), ("", "sigmoid"), ("eps", "0.03"))
    ),
]


def _of_the_package(rng):
    """Findings as questions make them, with words of theirs."""
    quantity, where, difference = _pick(rng, QUANTITIES), _pick(rng, PLACES), _differences(rng)
    value = rng.uniform(0.01, 1.0)
    estimate = Estimate(value, value / 2, min(2 * value, 1.0))
    other = _pick(rng, ["exact", "the tightest tolerance", "independent two-state blocks", "the unchanged systems"])
    level = Level(quantity, estimate, where, _pick(rng, [None, Comparison(other, difference)]), Basis(20))
    keys = tuple(KeyChange(key, "0.1", "0.4") for key in ("kappa", "friction")[: rng.integers(1, 3)])
    kinds = rng.permutation([*settled.PREDICATES.values()])[: rng.integers(1, 4)]
    predicates = tuple(predicate.format(" at t = 5000") for predicate in kinds)
    settings = tuple(f"sigmoid with eps = {eps}" for eps in (0.001, 0.01, 0.03, 0.1)[: rng.integers(1, 5)])
    turn = Turn(_pick(rng, Course), estimate, Place.key("kappa", "0.2"))
    yield level
    for way in ((), (turn,), 2 * (turn,), 4 * (turn,)):
        yield Change(quantity, keys, Estimate(0.3), Estimate(0.41), difference, where, Basis(20), way)
    yield Share("share", "starts", predicates[0], estimate, where, level.comparison, Basis(20), 5000)
    yield Regime("slide", "starts", predicates, 17, 20, estimate, where, Basis(20))
    b, scope = Level(Quantity("b", "b-value"), estimate, where), Level(SHARE, estimate)
    for fit in Fit:
        predicate = "follow a power law, below a peak, from M = -3.1 to 0.5"
        yield Law("moments of episodes", predicate, b, fit, scope=scope, things="episodes")
    parts = tuple(
        Level(Quantity(name, name), estimate) for name in ("finite size", "each block's own dynamics", "pull")
    )
    yield Parts(replace(level, comparison=None), parts, "decay rate")
    yield Outcomes(other, settings, (), settings, level, scope="the rate and magnitudes of episodes")
    yield Outcomes(other, (), settings, (), level, "exact with tol = 0.001", settings[1:])
    nouns = ("steady sliding", "stick-slip", "rest")[: rng.integers(1, 4)]
    yield Attracting(
        nouns, "belt_speed", "4.93", "7.85", _pick(rng, Bound), _pick(rng, Bound), where, Basis(20), "3000"
    )


def test_first_sentences_are_short(rng):
    """Whatever a question finds: of up to 25 words, a number with its power of ten being one; nothing is lost."""
    for _ in range(150):
        for finding in _of_the_package(rng):
            for said in (finding, *([] if isinstance(finding, Outcomes) else [Decided(_pick(rng, Truth), finding)])):
                first, *_ = re.split(r"(?<=\.) (?=[A-Z0-9]|n =|b-)", sentence(said))
                assert len(first.replace(" \u00d7 ", "").split()) <= 25, first
                for part in str(place_of(said)).split(", "):
                    assert part in sentence(said)


def test_the_table_of_findings_has_limits_and_differences_in_their_units():
    lower = Difference(Estimate(-0.3, -0.4, -0.2), Scale.ABSOLUTE)
    wider = Difference(Estimate(0.5, 0.25, 0.75), Scale.RELATIVE)
    rows = [
        *levels(Share("pairs", "exits", "trigger another", Estimate(high=0.0028))),
        *levels(Level(SHARE, Estimate(0.2), comparison=Comparison("others", lower))),
        *levels(Level(GAMMA, Estimate(0.7), comparison=Comparison("others", wider))),
    ]
    table = str(findings_table(rows).rows).replace("\\xa0", " ")
    for cell in ("at most 0.28%", "\u221230 (\u221240 to \u221220) percentage points", "+50% (+25 to +75%)"):
        assert cell in table


def test_a_table_names_once_what_all_settings_share_and_breaks_none_of_its_parts():
    rows = [Level(GAMMA, Estimate(0.7), Place((("n", "200"), ("eps", f"{k}")))) for k in range(30)]
    table = findings_table(rows, "a file")
    assert table.caption == "All at n = 200."
    assert [row[table.head.index("where")] for row in table.rows] == [f"eps\u00a0=\u00a0{k}" for k in range(30)]
    assert findings_table(rows[:1]).rows[0][1] == "n\u00a0=\u00a0200, eps\u00a0=\u00a00"


def test_a_cell_breaks_on_both_sides_of_an_interval_alone():
    lower = Difference(Estimate(-0.3, -0.4, -0.2), Scale.ABSOLUTE)
    table = findings_table([Level(SHARE, Estimate(0.2), comparison=Comparison("others", lower))])
    (cell,) = (row[table.head.index("difference")] for row in table.rows)
    assert cell.split(" ") == ["\u221230", "(\u221240\u00a0to\u00a0\u221220)", "percentage\u00a0points"]


def test_of_another_dataset_both_values_are_said():
    """No other finding says that of the other."""
    gone = Difference(Estimate(-1.0, -1.0, -0.9))
    value, speed = Estimate(0.0453, 0.0401, 0.0506), Quantity("v", "mean slip speed", unit="m/s")
    level = Level(speed, Estimate(0.0), comparison=Comparison("other", gone, value), basis=Basis(8))
    assert "below other at 0.0453 (0.0401 to 0.0506) m/s" in sentence(level)
    (row,) = findings_table([level]).rows
    assert "other: 0.0453 (0.0401\u00a0to\u00a00.0506)" in row
    said = findings_json("", [], [Part("a", "", Answer([level]), [], [""], [level])])["findings"][0]["rows"][0]
    assert [said[f"compared_{end}"] for end in ("with", "value", "low", "high")] == ["other", 0.0453, 0.0401, 0.0506]
    lead = sentence(Outcomes("other", different=("one",), largest=level, at_largest="one"))
    assert lead.endswith("lower than other, 0 against 0.0453 m/s.")


def test_the_first_screen_counts_the_rows_that_are_below():
    rows = [Level(GAMMA, Estimate(0.7), Place.key("n", f"{k}")) for k in range(40)]
    below = Part("a", "What?", Answer(rows[:1]), [], ["It is."], rows)
    assert below.head.note == "28 more rows in \u201cWhat?\u201d below."
    assert below.section([], True, False).table.note == "4 more rows in report/findings.json."


def test_symbols_begin_sentences_as_they_are():
    written = {
        "mean n": "Mean n",
        "a copy": "A copy",
        "n = 20": "n = 20",
        "\u03b3 has": "\u03b3 has",
        "t = 3": "t = 3",
    }
    assert {text: capital(text) for text in (*written, "")} == {**written, "": ""}


@pytest.mark.parametrize(
    ("share", "text"),
    [(1.0, "100%"), (0.99915, "99.9%"), (0.99996, "99.996%"), (1 - 1e-7, "99.99999%"), (0.0, "0%"), (1.5, "150%")],
)
def test_what_is_not_all_is_not_said_to_be(share, text):
    assert number(share, Form.SHARE) == text
