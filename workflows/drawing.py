"""The report's figures, drawn beside its statistics: in a process of their own, and here once these are done."""

from __future__ import annotations

import gc
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import TYPE_CHECKING

from stickslip.pipeline.processes import Child, ChildDied

if TYPE_CHECKING:
    from stickslip.analysis.report.page import Image
    from stickslip.analysis.report.section import Recipe


class Drawing:
    """Give a figure's recipe, get its image when it is needed; a context manager. The images are those drawn here.

    The process is there from the start, and loads what it needs meanwhile. Should it die, all is drawn here.
    """

    def __init__(self) -> None:
        self._child = Child(_drawn)
        self._asking = ThreadPoolExecutor(1)
        self._asking.submit(self._ask, None)  # what it needs is loaded before the first figure comes
        self._asked: list[tuple[Future[str | None], Recipe]] = []
        self._drawn_here: dict[Future[str | None], str] = {}

    def __enter__(self) -> Drawing:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._child.kill()
        self._asking.shutdown(cancel_futures=True)
        self._child.__exit__()

    def __call__(self, recipe: Recipe) -> Image:
        """Have a figure drawn; what is returned gives its image."""
        from stickslip.analysis.report.figures import embedded

        asked = self._asking.submit(self._ask, recipe)
        self._asked.append((asked, recipe))

        def image() -> str:
            self._draw_what_is_not_begun()
            there = None if asked.cancelled() else asked.result()
            return self._drawn_here.get(asked) or there or embedded(recipe())

        return image

    def _draw_what_is_not_begun(self) -> None:
        """Draw here, from the last on, until the process has begun all that is left.

        Done when the first image is asked for, as all that is missing then is images. An error of any recipe is
        raised there.
        """
        from stickslip.analysis.report.figures import embedded

        while self._asked:
            asked, recipe = self._asked.pop()
            if asked.cancel():
                self._drawn_here[asked] = embedded(recipe())

    def _ask(self, recipe: Recipe | None) -> str | None:
        try:
            return str(self._child(recipe))
        except ChildDied:
            return None


def _drawn(recipe: Recipe | None) -> str:
    """In the child: a figure's image; of no recipe, one that has the fonts found."""
    from matplotlib.figure import Figure

    from stickslip.analysis.report.figures import embedded

    gc.disable()  # figures are full of cycles, which are looked for again and again; of one report all find room
    return embedded(Figure() if recipe is None else recipe())
