"""Functions that questions put to runs, on processes beside this one and here."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from stickslip.analysis.series.runs import Ended
from stickslip.analysis.settings import AnalysisSettings
from stickslip.pipeline.dataset.opened import Opened
from stickslip.pipeline.machine.processes import Child, ChildDied
from stickslip.workflows.parts import Asked, Parts

T = TypeVar("T")

#: Runs that are asked about together, at least: opening their shards takes two milliseconds.
_LEAST = 2_000


class OnChildren:
    """Puts functions to the runs of a dataset.

    Parameters
    ----------
    opened : Opened
    settings : AnalysisSettings
    children : sequence of Child
        Each answers an `Asked`. What one dies of is asked again here, so that its error is seen.
    """

    def __init__(self, opened: Opened, settings: AnalysisSettings, children: Sequence[Child]) -> None:
        self._parts, self._children = Parts(opened, settings, _LEAST), list(children)

    def __call__(self, of: Callable[..., T], some: Ended, beside: Ended | None = None) -> list[tuple[list[int], T]]:
        """The places of the runs of each part among `some`, and what the function gives of these."""
        asked, places = self._parts.ask(of, some, beside)
        todo, found = deque(asked), dict[int, T]()

        def by_child(child: Child) -> None:
            while (one := _next(todo)) is not None:
                try:
                    found[one.number] = child(one)
                except ChildDied:
                    self._children.remove(child)
                    todo.append(one)
                    return

        def here() -> None:
            while (one := _next(todo)) is not None:
                found[one.number] = one.answer()

        with ThreadPoolExecutor(max(len(self._children), 1)) as pool:
            elsewhere = [pool.submit(by_child, child) for child in list(self._children)]
            try:
                here()
            except BaseException:  # Ctrl-C too: nobody waits for the rest
                todo.clear()
                for child in list(self._children):
                    child.kill()
                raise
            for one in elsewhere:
                one.result()
        here()
        return [(own, found[number]) for number, own in enumerate(places)]


def _next(todo: deque[Asked]) -> Asked | None:
    try:
        return todo.popleft()
    except IndexError:  # another took the last
        return None
