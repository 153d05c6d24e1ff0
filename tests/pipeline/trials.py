"""Children that try functions of a user's own, kept for the next trial: to start one takes longest of all."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

from stickslip.pipeline.machine.processes import Child
from stickslip.pipeline.own import files, function, modules


def anew(called: Callable[..., Any], *arguments: Any) -> Any:
    """In a child: try a function, and keep nothing that was loaded for it but this package.

    Its kernels know their classes by name.
    """
    before = set(sys.modules)
    found = called(*arguments)
    for name in set(sys.modules) - before:
        if name.startswith("stickslip."):
            continue
        file = getattr(sys.modules[name], "__file__", None)
        if file is None or not files.is_installed(Path(file)):
            del sys.modules[name]
    function._module.cache_clear()
    modules._modules.cache_clear()
    return found


class Kept(Child):
    """A child that waits to be the next one, unless it has died or owes an answer."""

    waiting: ClassVar[list[Kept]] = []
    owes = False

    @classmethod
    def next(cls) -> Kept:
        return cls.waiting.pop() if cls.waiting else cls()

    @classmethod
    def end(cls) -> None:
        while cls.waiting:
            Child.__exit__(cls.waiting.pop())

    def __call__(self, called: Callable[..., Any], *arguments: Any) -> Any:
        self.owes = True
        answer = super().__call__(anew, called, *arguments)
        self.owes = False
        return answer

    def __exit__(self, *error: object) -> None:
        if self.owes or self._process.poll() is not None:
            super().__exit__(*error)
        else:
            self.waiting.append(self)
