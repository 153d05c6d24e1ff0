"""The fuzz can fail: wrong engines, planted, are caught; and a short run of it, with a new seed each time."""

import math
import os
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numba.core.compiler_lock import global_compiler_lock

from stickslip.sim import EventSeries, Run, System, draw_system, simulate
from stickslip.sim.runs.run import Samples
from tests.fuzz import judge as judging
from tests.fuzz.draw import Trial, draw
from tests.fuzz.judge import Endless, exact_truth, judge, patience
from tests.fuzz.series import Stretches, compare
from tests.fuzz.workers import verdicts, within_limits
from tests.independent import Case
from tests.systems import FAMILIES, TERMS

DRAWN = draw_system("antisymmetric", 4, seed=3)
CASE = Case.of(DRAWN.stiffness, DRAWN.damping, 1, -0.2, -0.7, -0.4)
EXACT = Trial(0, 0, "antisymmetric", "coulomb", CASE, 6.0, {"tol": 1e-10})
SMOOTH = replace(EXACT, engine="sigmoid", settings={"eps": 0.03, "rtol": 1e-6, "atol": 1e-6, "thresholds": [1.0]})


def changed(change: Callable[[Run], Run]) -> Callable[..., Run]:
    return lambda *args, **settings: change(simulate(*args, **settings))


def series(run: Run, keep: np.ndarray) -> EventSeries:
    e = run.events
    return EventSeries(e.t[keep], e.block[keep], e.mode[keep], e.initial_mode, e.t_start, e.t_end)


def samples(run: Run, factor: float) -> Samples:
    return Samples(run.samples.t, run.samples.z, run.samples.w * factor)


@pytest.mark.parametrize("trial", [EXACT, SMOOTH], ids=["exact", "smooth"])
def test_what_is_right_passes(trial):
    verdict = judge(trial)
    assert verdict.failures == []
    assert 0 < verdict.worst < judging.LIMIT[trial.engine]


def without_one(run: Run) -> Run:
    return replace(run, events=series(run, np.arange(len(run.events)) != len(run.events) // 2))


def with_a_graze(run: Run) -> Run:
    """An event taken back at once."""
    twice = np.repeat(np.arange(len(run.events)), 3)
    events = series(run, twice)
    events.mode[1::3] = -1 - events.mode[1::3]
    return replace(run, events=events)


def shifted(run: Run) -> Run:
    e = run.by_threshold[1.0]
    late = EventSeries(e.t, e.block, e.mode, np.where(e.initial_mode == 0, 1, 0), e.t_start, e.t_end)
    return replace(run, by_threshold={1.0: late})


@pytest.mark.parametrize(("trial", "change", "words"), [
    (EXACT, lambda run: replace(run, z=run.z + 1e-6), "error"),
    (EXACT, lambda run: replace(run, w=run.w * np.nan), "no finite state"),
    (EXACT, lambda run: replace(run, samples=samples(run, 1 + 1e-5)), "error"),
    (EXACT, without_one, "series of block"),
    (EXACT, with_a_graze, "two events at one time"),
    (EXACT, lambda run: replace(run, t_end=float(np.nextafter(run.t_end, 0))), "at t = 5.99"),
    (EXACT, lambda run: replace(run, outcome="diverged", t_end=3.0, z=1e3 + run.z), "which it does not"),
    (SMOOTH, lambda run: replace(run, z=run.z + 1e-2), "error"),
    (SMOOTH, shifted, "threshold 1"),
])  # fmt: skip
def test_a_wrong_engine_is_caught(trial, change, words):
    assert any(words in failure for failure in judge(trial, changed(change)).failures)


def test_what_an_error_comes_to_is_that_of_the_motion():
    """z'' = z grows like exp(t); a damped block forgets: an error is then what the size of the state makes of it."""
    times = np.array([0.0, 10.0])
    grows, forgets = (
        exact_truth(Case.of(*system, 0, 0, 1, 1), times, 10.0, 1e-8, np.random.default_rng(0))
        for system in (([[-1.0]], 0), ([[1.0]], 2))
    )
    assert 1e3 < grows.unit[-1] / grows.unit[0] < 1e6
    assert forgets.unit[-1] == pytest.approx(2 * np.exp(-0.5))  # the largest of z = (1 + 2 t) exp(-t)


def only(when: Callable[..., bool], change: Callable[[Run], Run]) -> Callable[..., Run]:
    def run(system: System, *args: object, **settings: object) -> Run:
        found = simulate(system, *args, **settings)
        return change(found) if when(system, **settings) else found

    return run


@pytest.mark.parametrize(
    ("when", "words"),
    [
        (lambda system, **settings: settings.get("stop_early") is False, "stop_early=False"),
        (lambda system, **settings: settings.get("t_start", 0) > 0, "second half"),
        (lambda system, **settings: system.damping[0] != CASE.damping[0], "relabelled"),
        (lambda system, **settings: "t_eval" not in settings, "without samples"),
    ],
    ids=["without the early stop", "the second half", "relabelled", "without samples"],
)
def test_each_way_to_run_a_case_is_held(when, words):
    trial = replace(EXACT, seed=1)  # its blocks are renumbered so that the first is another
    found = judge(trial, only(when, lambda run: replace(run, z=run.z + 1e-5))).failures
    assert any(failure.startswith(words) for failure in found)
    assert not any(failure.startswith("plain") for failure in found)


def test_a_run_without_an_end_is_stopped(monkeypatch):
    monkeypatch.setattr(judging, "_PATIENCE", 1.0)  # the reference's too, which needs less for this

    def endless(*args: object, **settings: object) -> Run:
        while True:
            pass

    assert judge(replace(EXACT, t_end=0.5), endless).failures == ["plain: did not end in 1 s"]


def test_a_process_that_hangs_or_dies_is_replaced():
    [(_, hung)] = verdicts(time.sleep, [1000], time.monotonic() + 500, patience=0.5)
    assert hung.failures == ["its process ended: signal SIGKILL"]
    dead = [verdict.failures for _, verdict in verdicts(os._exit, [3, 4], time.monotonic() + 500)]
    assert dead == [["its process ended: exit code 3"], ["its process ended: exit code 4"]]


LINE = [(0.0, 1, 0.0), (2.0, 0, 1.0), (5.0, -1, 1e3)]


def replaced(k: int, t: float) -> Stretches:
    return [*LINE[:k], (t, *LINE[k][1:]), *LINE[k + 1 :]]


@pytest.mark.parametrize(("seen", "changed", "kind"), [
    (LINE, [LINE], "same"),
    (replaced(1, 2.0 + 1e-7), [LINE], "differs"),
    (replaced(1, 2.0 + 1e-7), [replaced(1, 2.0 - 1e-7)], "same"),
    (replaced(2, 5.0 + 1e-7), [LINE], "same"),  # an error moves it further
    ([*LINE, (7.0, 0, 1.0), (7.00001, -1, 1.0)], [LINE], "graze"),
    ([*LINE, (7.0, 0, 1.0), (7.1, -1, 1.0)], [LINE], "differs"),
    (LINE[:2], [LINE], "differs"),
    (LINE[:2], [LINE[:2]], "undecided"),  # a change of what the tolerance allows takes the exit away
    (LINE[:1], [LINE[:2]], "differs"),  # but not the entry
])  # fmt: skip
def test_series_are_compared_as_far_as_they_are_certain(seen, changed, kind):
    assert compare(seen, LINE, changed, error=1e-8, shortest=1e-4, t_end=10.0)[0] == kind


def test_the_exact_engine_on_every_family_and_the_smoothed_law_on_some(random_seed):
    """`python -m tests.fuzz` goes on."""
    print(f"python -m tests.fuzz --seed {random_seed}")
    n = len(FAMILIES)
    cases = [(random_seed, k, TERMS) for k in (*range(n), *range(2 * n, 3 * n, 3))]
    assert [draw(random_seed, k).engine for _, k, _ in cases] == ["coulomb"] * n + ["sigmoid"] * 4
    judged = verdicts(within_limits, cases, math.inf)
    wrong = {k: verdict.failures for (_, k, _), verdict in judged if verdict.failures}
    assert wrong == {}, f"python -m tests.fuzz --seed {random_seed} --case {next(iter(wrong))}"


def test_patience_waits_for_a_kernel_that_is_compiled():
    """What is raised in a callback of LLVM is lost, and numba then has no machine code to keep."""
    with patience(0.05):
        with global_compiler_lock:
            work(0.2)
        with pytest.raises(Endless):
            work(10.0)


def work(seconds: float) -> None:
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass
