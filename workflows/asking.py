"""The questions of a report, put to processes beside this one, or the runs that they ask about."""

from __future__ import annotations

import gc
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from stickslip.pipeline.machine.processes import Child, n_cores
from stickslip.pipeline.running.executor import Children, Executor, Here
from stickslip.workflows import own_questions

if TYPE_CHECKING:
    from stickslip.analysis.ensemble import Study
    from stickslip.analysis.page.parts import Answered
    from stickslip.pipeline.dataset.opened import Opened
    from stickslip.pipeline.running.cluster import Scheduling

MOST_PROCESSES = 4  # there are few questions, and the longest one takes its time
#: Runs that a process is asked about together, at least: opening their shards takes two milliseconds.
_LEAST = 2_000


class Asking:
    """Processes that load what they need while a run goes on, and answer questions once it is done.

    A context manager. There is one for each core but this process's own, none for a small dataset that is there,
    `opened`. Questions of the user's own, which may be run if `own` says where the scene or its copy lies, have a
    process each. With `workers`, local processes of dask, or a `scheduler` as of `pipeline.run_ensemble`, what
    questions ask of each run is computed there instead, and this process answers the questions.
    """

    def __init__(
        self,
        own: Path | None = None,
        with_pdf: bool = False,
        workers: int | None = None,
        scheduler: Scheduling = None,
        opened: Opened | None = None,
    ) -> None:
        self.own, self.with_pdf, self._workers, self._scheduler = own, with_pdf, workers, scheduler
        self._stack = ExitStack()
        self._is_spread = workers is not None or scheduler is not None
        is_alone = self._is_spread or (opened is not None and opened.is_small)
        n_children = 0 if is_alone else min(n_cores(), MOST_PROCESSES) - 1
        self._children = self._stack.enter_context(Children(n_children, _load))

    def __enter__(self) -> Asking:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def __call__(self, opened: Opened, study: Study, on_answer: Callable[[int, int], None]) -> list[Answered | None]:
        """The answer to each question, in their order, then those of the user's own that the scene asks, if it may.

        What a process fails at is asked again here, so that its error is seen; but for the user's own, whose errors
        are in their answers.
        """
        from stickslip.analysis.page.layout import prepare
        from stickslip.analysis.questions import package_questions, question

        names = package_questions(study.settings.question)
        longest_first = sorted(names, key=lambda key: -question(key).share)
        tasks = [] if self.own is None else own_questions.tasks(opened, self.own, self.with_pdf)
        n_asked = len(names) + len(tasks)
        answers: dict[str, Answered | None] = {}
        with ExitStack() as stack:
            executor = self._executor(stack, opened, study)
            pool = stack.enter_context(ThreadPoolExecutor(max(len(tasks), 1)))
            children = [stack.enter_context(Child(shows_errors=True)) for _ in tasks]
            own = [pool.submit(own_questions.put, *pair) for pair in zip(children, tasks, strict=True)]
            prepare()
            remember(opened, study)
            asked = partial(answer, opened, self.with_pdf)
            for results in executor.map(asked, longest_first):
                for number, answered in results:
                    answers[longest_first[number]] = answered
                    on_answer(len(answers), n_asked)
            for task, future in zip(tasks, own, strict=True):
                answers[task.name] = future.result()
                on_answer(len(answers), n_asked)
        return [answers[key] for key in (*names, *(task.name for task in tasks))]

    def _executor(self, stack: ExitStack, opened: Opened, study: Study) -> Executor:
        """Where questions are answered; where their functions are put to runs, the study is told."""
        from stickslip.pipeline.dataset.opened import MANY
        from stickslip.workflows.parts import Parts

        if self._is_spread:
            from stickslip.pipeline.running.cluster import check_address, connect
            from stickslip.pipeline.running.submit import Dask
            from stickslip.workflows.fresh import program

            if isinstance(self._scheduler, str):
                check_address(self._scheduler)
            client = stack.enter_context(connect(self._workers or 0, self._scheduler))
            workers = Dask(client, self._scheduler, "run the command again", version=program)
            there = replace(opened, place=opened.place.from_anywhere)
            study.put = Parts(there, study.settings, workers)
            return Here()
        if opened.n_done >= MANY:
            study.put = Parts(opened, study.settings, self._children, _LEAST)
            return Here()
        return self._children


def _load() -> None:
    """In a child: load what answering takes."""
    gc.disable()  # the process ends with the report
    from stickslip.analysis.page import parts  # noqa: F401
    from stickslip.workflows import reporting  # noqa: F401


#: The study of the dataset that this process was asked about last, and what tells it from others.
_latest: tuple[tuple[str, str], Study] | None = None


def remember(opened: Opened, study: Study) -> None:
    """Keep the study of a dataset for the questions to it that this process answers."""
    global _latest
    _latest = (str(opened.place), opened.manifest.digest), study


def answer(opened: Opened, with_pdf: bool, name: str) -> Answered | None:
    """The answer to a question about a dataset; None if its data do not raise it."""
    from stickslip.analysis.page.parts import ask
    from stickslip.workflows.reporting import study_of

    if _latest is None or _latest[0] != (str(opened.place), opened.manifest.digest):
        remember(opened, study_of(opened))
    assert _latest is not None
    return ask(_latest[1], name, with_pdf)
