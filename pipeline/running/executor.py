"""Where the parts of a work are computed: in this process, or in others beside it; `running.submit` has dask's."""

from __future__ import annotations

import pickle
import socket
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from queue import SimpleQueue
from typing import TypeVar

from stickslip.pipeline.machine.processes import Child, ChildDied

T = TypeVar("T")
R = TypeVar("R")

#: The numbers of parts, and what the function gave of each.
Results = Generator[list[tuple[int, R]]]


class Executor(ABC):
    """Computes the parts of a work."""

    @abstractmethod
    def map(self, function: Callable[[T], R], parts: Iterable[T]) -> Results[R]:
        """What a function gives of each part, in whatever order: those that are there together.

        A function that works in other processes is named at the top of a module, as are its arguments' classes.
        """


class Here(Executor):
    """This process."""

    def map(self, function: Callable[[T], R], parts: Iterable[T]) -> Results[R]:
        for number, argument in enumerate(parts):
            yield [(number, function(argument))]


class Children(Executor):
    """Processes beside this one, and this one; a context manager.

    Parameters
    ----------
    n : int
        How many.
    load : callable
        What each calls first, while this process goes on: it loads what functions need.
    """

    def __init__(self, n: int, load: Callable[[], None]) -> None:
        self._stack = ExitStack()
        self._children = [self._stack.enter_context(Child()) for _ in range(n)]
        self._pool = ThreadPoolExecutor(max(n, 1))
        self._loading = {child: self._pool.submit(_load, child, load) for child in self._children}

    def __enter__(self) -> Children:
        return self

    def __exit__(self, *_: object) -> None:
        for child in self._children:
            child.kill()
        self._pool.shutdown()
        self._stack.close()

    def map(self, function: Callable[[T], R], parts: Iterable[T]) -> Results[R]:
        """As `Executor.map`; what a process dies of is computed again here, so that its error is seen."""
        todo = deque(enumerate(parts))
        answers: SimpleQueue[tuple[int, R] | None] = SimpleQueue()

        def by_child(child: Child, loading: Future[None]) -> None:
            task = None
            try:
                loading.result()
                while (task := _next(todo)) is not None:
                    answers.put((task[0], child(function, task[1])))
            except ChildDied:
                self._loading.pop(child)
                if task is not None:
                    todo.append(task)
            finally:
                answers.put(None)

        futures = [self._pool.submit(by_child, *pair) for pair in [*self._loading.items()]]
        n_working = len(futures)
        try:
            while n_working or todo:
                if (task := _next(todo)) is not None:
                    answers.put((task[0], function(task[1])))
                answered = [answers.get(), *(answers.get() for _ in range(answers.qsize()))]
                n_working -= answered.count(None)
                yield [result for result in answered if result is not None]
        except BaseException:  # Ctrl-C too: nobody waits for the rest
            todo.clear()
            for child in [*self._loading]:
                child.kill()
            raise
        for future in futures:
            future.result()


def call_there(function: Callable[[T], R], part: bytes, version: Callable[[], str]) -> tuple[str, str, R]:
    """On a worker of dask: a version there, the machine, and what a function gives of a part, which comes pickled."""
    return version(), socket.gethostname(), function(pickle.loads(part))


def _load(child: Child, load: Callable[[], None]) -> None:
    with suppress(ChildDied):  # seen again when it is asked
        child(load)


def _next(todo: deque[tuple[int, T]]) -> tuple[int, T] | None:
    try:
        return todo.popleft()
    except IndexError:  # another took the last
        return None
