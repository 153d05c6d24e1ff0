"""The questions of a report, put to processes beside this one, or the runs that they ask about."""

from __future__ import annotations

import gc
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stickslip.pipeline.machine.processes import Child, ChildDied, n_cores
from stickslip.workflows import own_questions

if TYPE_CHECKING:
    from stickslip.analysis.ensemble import Study
    from stickslip.analysis.page.parts import Answered
    from stickslip.analysis.series.runs import Put
    from stickslip.pipeline.dataset.opened import Opened
    from stickslip.pipeline.running.cluster import Scheduling
    from stickslip.workflows.parts import Asked

MOST_PROCESSES = 4  # there are few questions, and the longest one takes its time
#: Members from which on the processes share the runs instead of the questions: going through the runs is most of it,
#: and what each process knows of the members fills the memory.
_MANY = 20_000


class Asking:
    """Processes that load what they need while a run goes on, and answer questions once it is done.

    A context manager. There is one for each core but this process's own.

    Parameters
    ----------
    own : Path, optional
        Where the scene lies, or its copy, if questions of the user's own may be run; each has a process of its own.
    with_pdf : bool
        Whether to draw figures as PDF too.
    workers : int, optional
        Local processes of dask that what questions ask of each run is computed by; instead of processes that answer
        questions.
    scheduler : str, distributed.Client or callable, optional
        Address of a running dask cluster to be used instead, or as of `pipeline.run_ensemble`.
    """

    def __init__(
        self,
        own: Path | None = None,
        with_pdf: bool = False,
        workers: int | None = None,
        scheduler: Scheduling = None,
    ) -> None:
        self.own, self.with_pdf, self._workers, self._scheduler = own, with_pdf, workers, scheduler
        self._stack = ExitStack()
        self._is_spread = workers is not None or scheduler is not None
        n_children = 0 if self._is_spread else min(n_cores(), MOST_PROCESSES) - 1
        self._children = [self._stack.enter_context(Child(answer)) for _ in range(n_children)]
        self._pool = ThreadPoolExecutor(max(n_children, 1))
        self._loading = [(child, self._pool.submit(_load, child)) for child in self._children]

    def __enter__(self) -> Asking:
        return self

    def __exit__(self, *_: object) -> None:
        for child in self._children:
            child.kill()
        self._pool.shutdown()
        self._stack.close()

    def __call__(self, opened: Opened, study: Study, on_answer: Callable[[int, int], None]) -> list[Answered | None]:
        """The answer to each question, in their order, then those of the user's own that the scene asks, if it may.

        What a process fails at is asked again here, so that its error is seen; but for the user's own, whose errors
        are in their answers.
        """
        from stickslip.analysis.page.layout import prepare
        from stickslip.analysis.page.parts import ask
        from stickslip.analysis.questions import package_questions, question
        from stickslip.workflows.on_children import OnChildren

        names = package_questions(study.settings.question)
        to_go = deque(sorted(names, key=lambda key: -question(key).share))
        found: dict[str, Answered | None] = {}
        tasks = [] if self.own is None else own_questions.tasks(opened, self.own, self.with_pdf)
        n_asked = len(names) + len(tasks)

        def next_ones() -> Iterator[str]:
            with suppress(IndexError):  # none is left
                while True:
                    yield to_go.popleft()

        def by_child(child: Child, loading: Future[None]) -> None:
            loading.result()
            with suppress(ChildDied):  # its questions are then answered by others
                child(opened)
            for key in next_ones():
                try:
                    found[key] = child((key, self.with_pdf))
                except ChildDied:
                    to_go.append(key)
                    return
                on_answer(len(found), n_asked)

        def by_own(child: Child, task: own_questions.Task) -> None:
            found[task.name] = own_questions.put(child, task)
            on_answer(len(found), n_asked)

        def here() -> None:
            for key in next_ones():
                found[key] = ask(study, key, self.with_pdf)
                on_answer(len(found), n_asked)

        is_many = opened.n_done >= _MANY
        if is_many and not self._is_spread:
            for _, loading in self._loading:
                loading.result()
            study.put = OnChildren(opened, study.settings, self._children)
        if self._is_spread:
            study.put = self._stack.enter_context(_spread(opened, study, self._workers or 0, self._scheduler))
        asked = [] if is_many else [self._pool.submit(by_child, *one) for one in self._loading]
        if tasks:
            pool = self._stack.enter_context(ThreadPoolExecutor(len(tasks)))
            alone = [self._stack.enter_context(Child(own_questions.answer, shows_errors=True)) for _ in tasks]
            self._children += alone
            asked += [pool.submit(by_own, *one) for one in zip(alone, tasks, strict=True)]
        prepare()
        here()
        for one in asked:
            one.result()
        here()
        return [found[key] for key in (*names, *(task.name for task in tasks))]


@contextmanager
def _spread(opened: Opened, study: Study, workers: int, scheduler: Scheduling) -> Iterator[Put]:
    """Puts functions to runs on workers of dask, which are there as long as the with-block."""
    from stickslip.pipeline.running.cluster import check_address, connect
    from stickslip.workflows.on_workers import OnWorkers

    if isinstance(scheduler, str):
        check_address(scheduler)
    with connect(workers, scheduler) as client:
        yield OnWorkers(opened, study.settings, client, scheduler)


def _load(child: Child) -> None:
    try:
        child(None)
    except ChildDied:  # seen again when it is asked
        return


#: In a child: the study of the dataset that it was handed last.
_study: Study | None = None


def answer(argument: Opened | Asked | tuple[str, bool] | None) -> Any:
    """In a child: load what answering takes (None), take over a dataset, or answer one question to it.

    A question is its name, and whether to draw figures as PDF too; or else what is asked of some runs.
    """
    global _study
    gc.disable()  # the process ends with the report
    from stickslip.analysis.page.parts import ask
    from stickslip.pipeline.dataset.opened import Opened
    from stickslip.workflows.parts import Asked
    from stickslip.workflows.reporting import study_of

    if isinstance(argument, Asked):
        return argument.answer()
    if isinstance(argument, Opened):
        _study = study_of(argument)
    elif argument is not None:
        assert _study is not None
        return ask(_study, *argument)
    return None
