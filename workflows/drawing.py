"""The report's figures, drawn beside its statistics: in a process of their own, and here once these are done."""

from __future__ import annotations

import contextlib
import gc
import pickle
import sys
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import TYPE_CHECKING

from stickslip.pipeline.processes import Child, answering

if TYPE_CHECKING:
    from stickslip.analysis.report import Image
    from stickslip.analysis.section import Recipe


class Drawing:
    """Give a figure's recipe, get its image when it is needed; a context manager. The images are those drawn here.

    The process is there from the start, and loads what it needs meanwhile. Should it die, all is drawn here.
    """

    def __init__(self) -> None:
        self._process = Child("from stickslip.workflows.drawing import serve; serve()")
        self._asking = ThreadPoolExecutor(1)
        self._asked: list[tuple[Future[str | None], Recipe]] = []
        self._drawn_here: dict[Future[str | None], str] = {}

    def __enter__(self) -> Drawing:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._asking.shutdown(cancel_futures=True)
        with contextlib.suppress(BrokenPipeError):  # of what it no longer reads
            self._process.__exit__(kind, error, trace)

    def __call__(self, recipe: Recipe) -> Image:
        """Have a figure drawn; what is returned gives its image."""
        from stickslip.analysis.figures import embedded

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
        from stickslip.analysis.figures import embedded

        while self._asked:
            asked, recipe = self._asked.pop()
            if asked.cancel():
                self._drawn_here[asked] = embedded(recipe())

    def _ask(self, recipe: Recipe) -> str | None:
        try:
            pickle.dump(recipe, self._process.to_it)
            self._process.to_it.flush()
            return str(pickle.load(self._process.from_it))
        except (OSError, EOFError, pickle.UnpicklingError):  # it is dead, or was killed half-way through an answer
            return None


def serve() -> None:
    """Draw the figures whose recipes come in, until no more can come."""
    answers = answering()
    from matplotlib.figure import Figure

    from stickslip.analysis.figures import embedded

    gc.disable()  # figures are full of cycles, which are looked for again and again; of one report all find room
    embedded(Figure())  # meanwhile: the first figure has to find the fonts
    while True:
        try:
            recipe = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        pickle.dump(embedded(recipe()), answers)
        answers.flush()
