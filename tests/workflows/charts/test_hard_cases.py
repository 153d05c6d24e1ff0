"""The hard cases: each known answer against an independent computation, and the rule that judges."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stickslip import sim
from stickslip.workflows.charts import hard_cases, peers
from stickslip.workflows.charts.hard_cases import ONE_BLOCK, judge
from stickslip.workflows.charts.peers import METHODS, Method, MethodError, Solution

CASES = {case.name: case for case in hard_cases.hard_cases()}
ENGINES = ("coulomb engine", "sigmoid engine")
#: What the 34-digit reference takes seconds for, or what ends before its end.
SLOW = {"K of 1 and 1e6", "overdamped, R = 1e6", "t_end = 1e6", "growth without bound", "five identical blocks"}
CLOSED = sorted(name for name, case in CASES.items() if "coulomb engine" in case.methods and name not in SLOW)


@pytest.fixture(scope="module")
def follow():
    """The event-driven reference in 34-digit arithmetic, which shares nothing with the engines."""
    file = Path(__file__).parents[2] / "sim" / "reference.py"
    spec = importlib.util.spec_from_file_location("reference_of_sim", file)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module.follow


@pytest.mark.parametrize("name", CLOSED)
def test_what_is_known_is_what_the_reference_finds(name, follow):
    case = CASES[name]
    scale = case.scale
    system = sim.System(
        case.system.stiffness, case.system.damping, case.system.friction / scale, case.system.belt_speed / scale
    )
    t_end = min(case.t_end, 8.0)
    found = follow(system, case.z0 / scale, case.w0 / scale, t_end)
    np.testing.assert_allclose(found.z, case.z_at(t_end) / scale, rtol=0, atol=1e-10)
    if case.events is None:
        return
    known = sorted(event for event in case.events if event[0] <= t_end)
    listed = sorted(zip(found.t, found.block, found.mode, strict=True))
    assert [event[1:] for event in listed] == [event[1:] for event in known]
    np.testing.assert_allclose([event[0] for event in listed], [event[0] for event in known], rtol=0, atol=1e-11)


def test_five_copies_are_one_block():
    case, one = CASES["five identical blocks"], CASES["t_end = 1e6"]
    for t in (0.2, 1.0, 3.5, 15.0):
        np.testing.assert_allclose(case.z_at(t), np.full(5, one.z_at(t)), atol=1e-12)


def test_the_overdamped_block_passes_the_belt_when_it_should():
    """From 40 digits of the same linear motion: at the known time w = v up to what neglecting K (z - z0) costs."""
    case = CASES["overdamped, R = 1e6"]
    ((t, *_),) = case.events
    h = 1e-9  # a thousandth of 1 / R
    w = (case.z_at(t)[0] - case.z_at(t - h)[0]) / h
    assert w == pytest.approx(-0.2, abs=2e-4)


def test_the_fast_block_is_a_cosine():
    case = CASES["K of 1 and 1e6"]
    for t in (0.3, 2.0, 5.0):
        assert case.z_at(t)[1] == pytest.approx(np.cos(1000 * t), abs=1e-9)
    free = [t for t, block, _ in case.events if block == 1]
    np.testing.assert_allclose(-1000 * np.sin(1000 * np.array(free)), -0.2, atol=1e-8)
    assert len(free) == np.count_nonzero(np.diff(np.sign(-1000 * np.sin(1000 * np.linspace(0, 5, 200_001)) + 0.2)))


def test_growth_is_what_the_eigenvalues_say():
    case = CASES["growth without bound"]
    growth = np.linalg.eigvals(case.system.slip_matrix()).real.max()
    assert growth == pytest.approx(0.99, abs=0.01)
    assert growth * case.t_end > np.log(np.finfo(float).max)


@pytest.mark.parametrize("name", sorted(CASES))
def test_neither_engine_is_wrong(name):
    for method in ENGINES:
        if method in CASES[name].methods:
            verdict = judge(CASES[name], method, 1.0)
            assert verdict.answer in ("right", "refused"), verdict
            assert verdict.answer == "right" or verdict.reason
            assert method == "sigmoid engine" or verdict.answer == "right"


# ---------------------------------------------------------------------------------------------- the rule


ONE = CASES["t_end = 1e6"]


def short(**changes):
    return replace(ONE, t_end=6.0, outcome="finished", **changes)


def test_a_wrong_answer_is_called_wrong():
    assert judge(short(), "coulomb engine", 1.0).answer == "right"
    moved = short(z_at=lambda t: ONE.z_at(t) + 1e-7)
    assert judge(moved, "coulomb engine", 1.0).answer == "wrong"
    assert judge(moved, "sigmoid engine", 1.0).answer == "right"  # within what the laws differ by
    assert judge(short(z_at=lambda t: ONE.z_at(t) + 1e-2), "sigmoid engine", 1.0).answer == "wrong"
    late = judge(short(events=tuple((t + 1e-5, *rest) for t, *rest in ONE_BLOCK)), "coulomb engine", 1.0)
    assert (late.answer, round(late.error_t, 7)) == ("wrong", 1e-5)
    missing = judge(short(events=ONE_BLOCK[:2]), "coulomb engine", 1.0)
    assert (missing.answer, missing.error_t, missing.n_events, missing.n_known) == ("wrong", None, 3, 2)
    assert judge(replace(ONE, outcome="diverged", t_end=6.0), "coulomb engine", 1.0).answer == "wrong"


@pytest.mark.parametrize(
    ("z", "answer"),
    [(lambda: ONE.z_at(6.0), "right"), (lambda: ONE.z_at(6.0) + 1, "wrong"), (lambda: [np.nan], "wrong")],
)
def test_peers_are_held_to_what_is_known(monkeypatch, z, answer):
    method = Method("SciPy LSODA", "sigmoid", lambda problem: lambda tolerance: Solution(np.array(z())))
    monkeypatch.setattr(peers, "METHODS", (*(m for m in METHODS if m.name != method.name), method))
    assert judge(short(), "SciPy LSODA", 1.0).answer == answer
    diverging = replace(CASES["growth without bound"], t_end=6.0)
    assert judge(diverging, "SciPy LSODA", 1.0).answer == "wrong"  # any number is, as a success


def test_an_error_is_a_refusal_with_its_words(monkeypatch):
    def prepare(problem):
        raise MethodError("not here")

    monkeypatch.setattr(peers, "METHODS", (Method("SciPy LSODA", "sigmoid", prepare),))
    verdict = judge(short(), "SciPy LSODA", 1.0)
    assert (verdict.answer, verdict.reason) == ("refused", "not here")


def test_a_peer_runs_out_of_patience():
    assert judge(short(), "SciPy DOP853", 1e-9).answer == "too slow"
