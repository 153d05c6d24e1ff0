"""Questions of a user's own: code beside the scene, run in a process each, after a run and with `--own`."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from stickslip.pipeline.errors import SceneError, foreign, shortened
from stickslip.pipeline.machine.processes import Child, ChildDied
from stickslip.pipeline.own import function as own
from stickslip.pipeline.own.files import content_of, digest, name_beside
from stickslip.pipeline.own.modules import folder_with
from stickslip.pipeline.own.trial import LONGEST_TRIAL

if TYPE_CHECKING:
    from stickslip.analysis.ensemble import Study
    from stickslip.analysis.page.parts import Answered
    from stickslip.pipeline import Scene
    from stickslip.pipeline.dataset.opened import Opened

#: Seconds that a question has for its answer, its figures and its words.
LONGEST = 600.0

#: What errors begin with that are about its file.
_KEY = "analysis.question"
_ANSWER = "a stickslip.analysis.Answer"
_MOST = 400  # characters of what an error says


class Task(NamedTuple):
    """What a child is to do: ask the question `module:function` of a dataset, or only load its code if there is none.

    The folder is where the scene lies, or its copy: the module is looked for there, above, and where Python finds it.
    """

    name: str
    folder: str
    opened: Opened | None = None
    with_pdf: bool = False


def names(scene: Scene) -> tuple[str, ...]:
    """The questions of a user's own that a scene asks."""
    from stickslip.analysis.questions import is_own

    return tuple(name for name in dict.fromkeys(scene.analysis.question) if is_own(name))


def tasks(opened: Opened, folder: Path, with_pdf: bool) -> list[Task]:
    """What the questions of a user's own are that a dataset's scene asks; `folder` is as in `Task`."""
    return [Task(name, str(folder), opened, with_pdf) for name in names(opened.scene)]


def check(scene: Scene, folder: Path, name: str) -> None:
    """See that the code of a scene's questions can be loaded, before hours are spent on its runs.

    Raises `SceneError` if some cannot; one line a problem. `name` is what they call the scene.
    """
    loading = [Task(entry, str(folder)) for entry in names(scene)]
    for task in loading:  # a file that is not there is told without a process
        own.resolve(task.name, _place(task), f"{name}: {_KEY}: {task.name}")
    with ExitStack() as stack:
        pool = stack.enter_context(ThreadPoolExecutor(max(len(loading), 1)))
        children = [stack.enter_context(Child()) for _ in loading]
        answers = list(pool.map(lambda child, task: put(child, task, LONGEST_TRIAL), children, loading))
    problems = [f"{name}: {_KEY}: {entry.key}: {entry.problem}" for entry in answers if entry.problem]
    if problems:
        raise SceneError("\n".join(problems))


def put(child: Child, task: Task, longest: float | None = None) -> Answered:
    """What a child answers to a task, or why it does not, within a number of seconds (default: `LONGEST`)."""
    from stickslip.analysis.page.parts import Answered

    longest = LONGEST if longest is None else longest
    with child.within(longest) as is_late:
        try:
            answered = child(answer, task)
        except ChildDied as death:
            how = "got none" if is_late.is_set() else f"its process ended ({death})"
            answered = Answered(
                task.name, problem=f"expected an answer within {longest:g} s, {how}; correct the function"
            )
    return answered


# ---------------------------------------------------------------------------------------------- in the child


def answer(task: Task) -> Answered:
    """In a child: load the code of a question and, if there is a dataset, ask it."""
    sys.stdin = open(os.devnull)  # its own is what it is asked by  # noqa: SIM115
    import matplotlib

    matplotlib.use("agg")
    from stickslip.analysis.page.parts import Answered

    function, before = None, set(sys.modules)
    try:
        function = own.resolve(task.name, _place(task), _KEY)
        answered = _asked(task, function)
    except BaseException as error:  # noqa: BLE001  whatever it is, it is told in a line
        answered = Answered(task.name, problem=_told(error, _ANSWER, function))
    if function is None:
        return answered
    return replace(answered, sources=_sources(function, set(sys.modules) - before))


def _place(task: Task) -> Path:
    """The folder of a question's module."""
    return folder_with(task.name.partition(":")[0], Path(task.folder))


def _asked(task: Task, function: own.OwnFunction) -> Answered:
    from stickslip.analysis.page.own import own_answer
    from stickslip.analysis.page.parts import Answered
    from stickslip.analysis.pictures import by_defaults
    from stickslip.workflows.reporting import study_of

    if task.opened is None:
        own.use(function, callable, is_trial=True)  # loads it
        return Answered(task.name)
    study = study_of(task.opened, whole=True)

    def ask(question: Callable[[Study], object]) -> Answered:
        return own_answer(task.name, question, question(study), partial(_told, function=function), task.with_pdf)

    with by_defaults():
        asked: Answered = own.use(function, ask, is_trial=True)  # its figures may load modules too
    return asked


def _sources(function: own.OwnFunction, loaded: Iterable[str]) -> Mapping[str, str]:
    """The files of a question, and the sha256 of each: its module, and modules beside it."""
    file = own.module_file(function)
    modules = {path for name in loaded if (path := getattr(sys.modules.get(name), "__file__", None))}
    files = [file, *map(Path, sorted(modules - {str(file)}))]
    named = {one: name_beside(str(one), function.root) for one in files}
    named[file] = named[file] or str(file)  # it may be installed
    return {name: digest(content_of(one, _KEY)) for one, name in named.items() if name is not None}


def _told(error: BaseException, expected: str, function: own.OwnFunction | None) -> str:
    """An error in a line, with the last line of the user's code that it went through."""
    from stickslip.analysis.page.own import OwnError

    if isinstance(error, SceneError):
        return str(error).removeprefix(f"{_KEY}: ")
    if isinstance(error, OwnError):
        return shortened(str(error), _MOST)
    file = "" if function is None else str(own.module_file(function))
    lines = [line for line in traceback.extract_tb(error.__traceback__) if line.filename == file]
    where = [f"{Path(lines[-1].filename).name}, line {lines[-1].lineno}"] if lines else []
    where = [*(shortened(str(note), _MOST) for note in getattr(error, "__notes__", ())), *where]
    said = f"expected {expected}, but it raised {foreign(error)}"
    return f"{said} ({'; '.join(where)})" if where else said
