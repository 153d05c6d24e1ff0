"""Trying a function of a user's own before it is relied on: in children, twice, within a time."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from stickslip.pipeline.errors import SceneError, foreign
from stickslip.pipeline.machine.processes import Child, ChildDied
from stickslip.pipeline.own.files import content_of, digest, name_beside
from stickslip.pipeline.own.modules import hiding

#: Seconds that a child has for its calls of a function.
LONGEST_TRIAL = 40.0


class Trial(NamedTuple):
    """What is tried of one function, or of several of one module."""

    key: str  #: what errors begin with
    at: str  #: the folder of the scene
    #: `attempt()` calls them once, with `is_trial`, and gives what must be the same each time, as bytes, and facts to
    #: be kept, as plain values. It is pickled: named at the top of a module, or a `partial` of such.
    attempt: Callable[[], tuple[bytes, dict[str, Any]]]
    called: str  #: the call in words, for errors
    expected: str  #: what it is to give, in words
    differs: str = ""  #: what is wrong, and what to do, if it gives different things
    ready: Callable[[], object] | None = None  #: called before, in each child; it takes its time
    #: As `attempt`, which the other process calls in its place: the same in another order.
    elsewhere: Callable[[], tuple[bytes, dict[str, Any]]] | None = None


def tried(trial: Trial) -> dict[str, Any]:
    """The facts of what was called twice, and in another process too; with `beside`, the files that it reads.

    Raises `SceneError` if that goes wrong, what it gives differs, or it takes longer than `LONGEST_TRIAL`.
    """
    # what a module draws when it is loaded, or what depends on the order of a set, differs between processes
    with ThreadPoolExecutor(1) as aside, Child() as child, Child() as second:
        answer_of_second = aside.submit(_answer, second, trial._replace(attempt=trial.elsewhere or trial.attempt), 1)
        problem, facts = _answer(child, trial, 2)
        if not problem and facts.pop("digest") != answer_of_second.result()[1].get("digest"):
            problem, facts = answer_of_second.result()[0] or trial.differs, {}
    return _judged(trial, problem, facts)


def tried_once(trial: Trial) -> dict[str, Any]:
    """The facts of what was called in one child; as `tried`."""
    with Child() as child:
        return _judged(trial, *_answer(child, trial, 1))


def _judged(trial: Trial, problem: str, facts: dict[str, Any]) -> dict[str, Any]:
    if problem:
        key = trial.key
        raise SceneError(
            problem if problem.startswith(key) else f"{key}: {trial.called}: {problem}; correct the function"
        )
    return facts


def _answer(child: Child, trial: Trial, times: int) -> tuple[str, dict[str, Any]]:
    """What a child says after some calls, within the time for these."""
    try:
        if trial.ready is not None:
            child(trial.ready)
        with child.within(LONGEST_TRIAL):
            return child(_try, trial, times)
    except ChildDied as death:
        return f"expected {trial.expected} within {LONGEST_TRIAL:g} s, its process died ({death})", {}


def _try(trial: Trial, times: int) -> tuple[str, dict[str, Any]]:
    """In a child, call some times: what is wrong with it, or else facts of what it gave and read."""
    audit = _Audit()
    sys.addaudithook(audit)
    answers, problem = [], ""
    try:
        answers = [trial.attempt() for _ in range(times)]
    except SceneError as error:
        problem = str(error)
    except BaseException as error:  # noqa: BLE001  whatever it is, it is told in a line
        problem = f"expected {trial.expected}, got {foreign(error)}"
    files = _beside(trial, audit)
    if hides := hiding(Path(trial.at), files):  # which may be why it went wrong
        problem = (
            f"{trial.key}: expected no file beside the scene with the name of an installed module that is imported,"
            f" got {hides}; rename it"
        )
    if problem:
        return problem, {}
    digests = {digest(content) for content, _ in answers}
    if len(digests) > 1:
        return trial.differs, {}
    return "", {**answers[0][1], "beside": files, "digest": digests.pop()}


class _Audit:
    """A hook of Python's audit while a function is tried: refuses forks, and notes the files that are opened."""

    def __init__(self) -> None:
        self.read: set[str] = set()
        self.written: set[str] = set()
        self._modules = set(sys.modules)

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        match event, arguments:
            case (("os.fork" | "os.forkpty"), _):
                raise RuntimeError("a function that a scene names may not fork")
            case "open", (str() | bytes() as file, _, int() as flags):
                paths = self.read if flags & os.O_ACCMODE == os.O_RDONLY else self.written
                paths.add(os.path.abspath(os.fsdecode(file)))

    @property
    def files(self) -> set[str]:
        """What was read, and not written; of compiled modules the audit hears nothing."""
        modules = [sys.modules.get(name) for name in set(sys.modules) - self._modules]
        loaded = {file for module in modules if (file := getattr(module, "__file__", None))}
        return (self.read | loaded) - self.written


def _beside(trial: Trial, audit: _Audit) -> dict[str, str]:
    """The sha256 of each file that was read and lies in the scene's folder or below, by its path there."""
    root, digests = Path(trial.at), {}
    for name in {name for file in audit.files if (name := name_beside(file, root)) is not None}:
        with contextlib.suppress(SceneError):  # it is gone, or no plain file
            digests[name] = digest(content_of(root / name, trial.key))
    return dict(sorted(digests.items()))
