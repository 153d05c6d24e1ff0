"""Cases judged in a process of their own, which may hang or die."""

from __future__ import annotations

import resource
import signal
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from stickslip.pipeline.machine.processes import Child, ChildDied
from tests.fuzz.draw import draw, draw_for_waves
from tests.fuzz.judge import Verdict, judge
from tests.fuzz.relations import judge_relations, judge_relations_by_waves
from tests.systems import TERMS

_WORK = 120.0  # seconds of its own time that a case may take before its process is killed
PATIENCE = 15 * _WORK  # seconds by the clock, for one that hangs; a busy machine stops no case
_MEMORY = 4 << 30  # bytes of address space beyond what the process has


#: What cases are held against: an independent engine, also where runs are made by waveform relaxation, or other runs.
JUDGES: dict[str, Callable[[int, int, Collection[str]], Verdict]] = {
    "reference": lambda seed, number, terms: judge(draw(seed, number, terms)),
    "waves": lambda seed, number, terms: judge(draw_for_waves(seed, number, terms)),
    "relations": judge_relations,
    "relations-of-waves": judge_relations_by_waves,
}


def judge_case(seed: int, number: int, terms: Collection[str] = TERMS, against: str = "reference") -> Verdict:
    """Of one case; the run goes on if the fuzz itself fails."""
    try:
        return JUDGES[against](seed, number, terms)
    except Exception as error:  # noqa: BLE001  reported as a failure of the case
        return Verdict(failures=[f"the fuzz itself: {type(error).__name__}: {error}"])


def within_limits(case: tuple[int, int, Collection[str]] | tuple[int, int, Collection[str], str]) -> Verdict:
    """`judge_case`, in a process that is killed for it if need be."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + _MEMORY, resource.RLIM_INFINITY))
    signal.setitimer(signal.ITIMER_VIRTUAL, _WORK)  # without a handler it kills, also inside a kernel
    return judge_case(*case)


def verdicts(
    judged: Callable[[Any], Verdict], cases: Iterable[Any], until: float, patience: float = PATIENCE
) -> Iterator[tuple[Any, Verdict]]:
    """Of the cases, one after another, until the clock says so; a process that does not answer is replaced."""
    with ExitStack() as children:
        child = children.enter_context(Child(shows_errors=True))
        for case in cases:
            if time.monotonic() > until:
                return
            guard = threading.Timer(patience, child.kill)
            guard.start()
            try:
                verdict = child(judged, case)
            except ChildDied as error:
                verdict = Verdict(failures=[f"its process ended: {error}"])
                child = children.enter_context(Child(shows_errors=True))
            finally:
                guard.cancel()
            yield case, verdict
