"""Children in which functions of systems are tried, kept for the next trial: to start one takes longest of all."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

from stickslip.pipeline.machine.processes import Child
from stickslip.pipeline.scene import systems


def anew(task: Any) -> Any:
    """In a child: try a function, and keep nothing that was loaded for it."""
    before = set(sys.modules)
    found = systems._try(task)
    for name in set(sys.modules) - before:
        file = getattr(sys.modules[name], "__file__", None)
        if file is None or not systems._is_installed(Path(file)):
            del sys.modules[name]
    systems._function.cache_clear()
    systems._modules.cache_clear()
    return found


class Kept(Child):
    """A child that waits to be the next one, unless it has died or owes an answer."""

    waiting: ClassVar[list[Kept]] = []
    owes = False

    @classmethod
    def next(cls, function: Callable[[Any], Any]) -> Kept:
        assert function is systems._try
        return cls.waiting.pop() if cls.waiting else cls(anew)

    @classmethod
    def end(cls) -> None:
        while cls.waiting:
            Child.__exit__(cls.waiting.pop())

    def __call__(self, argument: object) -> Any:
        self.owes = True
        answer = super().__call__(argument)
        self.owes = False
        return answer

    def __exit__(self, *error: object) -> None:
        if self.owes or self._process.poll() is not None:
            super().__exit__(*error)
        else:
            self.waiting.append(self)
