"""Make datasets, write what their reports say, compare; see `tests.statements`."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from pathlib import Path

import matplotlib

from stickslip.analysis import Report
from stickslip.analysis.page import parts
from stickslip.analysis.questions import package_questions
from stickslip.pipeline import load_scene, run_ensemble
from stickslip.pipeline.ensemble import pack
from stickslip.workflows import own_questions, reporting
from tests import statements
from tests.statements.scenes import COMPARED, PLANS, Plan

STATEMENTS = "statements.txt"
_NUMBER = re.compile(r"[-+\u2212]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_MADE_BY = ("stickslip: ", "Code beside the scene")  # digests, which change with any line of the program


class _Text(HTMLParser):
    """The text of a page: a line a sentence, a row of a table in one."""

    BLOCKS = ("p", "li", "h1", "h2", "h3", "h4", "tr", "figcaption", "summary", "details", "table", "ul", "div")

    def __init__(self) -> None:
        super().__init__()
        self._pieces: list[str] = []
        self._n_silent = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._n_silent += tag in ("style", "script")
        self._pieces.append("\n" if tag in self.BLOCKS else " | " if tag in ("td", "th") else "")
        self._pieces += [f"\n{value}\n" for name, value in attrs if name == "alt" and value]

    def handle_endtag(self, tag: str) -> None:
        self._n_silent -= tag in ("style", "script")
        self._pieces.append("\n" if tag in self.BLOCKS else "")

    def handle_data(self, data: str) -> None:
        if not self._n_silent:
            self._pieces.append(re.sub(r"\s+", " ", data))

    def lines(self) -> list[str]:
        text = "".join(self._pieces)
        blocks = (re.sub(r"\s+", " ", block).strip(" |") for block in text.split("\n"))
        return [
            sentence
            for block in blocks
            if not block.startswith(_MADE_BY)
            for sentence in re.split(r"(?<=[.?!]) (?=[A-Z])", block)
            if sentence
        ]


def sentences(html: str) -> list[str]:
    """What a page says, one sentence or one row of a table a line."""
    text = _Text()
    text.feed(html)
    return text.lines()


def make(name: str, plan: Plan, datasets: Path) -> None:
    """Run a plan into `datasets`/name/name, with its files beside; what breaks off leaves nothing under that name."""
    folder = datasets / f".{name}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for file, content in plan.files.items():
        if callable(content):
            content(folder / file)
        else:
            (folder / file).write_text(content)
    for k, text in enumerate(plan.scenes, 1):
        (folder / "scene.toml").write_text(text)
        with _broken_off(plan.n_shards if k == len(plan.scenes) else None) as on_progress:
            run_ensemble(load_scene(folder / "scene.toml"), folder / name, workers=0, on_progress=on_progress)
    folder.rename(datasets / name)


@contextlib.contextmanager
def _broken_off(n_shards: int | None) -> Iterator[Callable[[object], None] | None]:
    """What ends a run, of a few members a shard, after some of them."""
    if n_shards is None:
        yield None
        return
    shards = set()

    def end(progress) -> None:
        shards.add(progress.last_shard)
        if len(shards - {None}) == n_shards:
            raise KeyboardInterrupt

    before, pack.TARGET_COST = pack.TARGET_COST, 3.5e-3
    try:
        with contextlib.suppress(KeyboardInterrupt):
            yield end
    finally:
        pack.TARGET_COST = before


def _answers(opened, study, on_answer):
    own = [own_questions.answer(task) for task in own_questions.tasks(opened, opened.folder, with_pdf=False)]
    return [*(parts.ask(study, key) for key in package_questions(study.settings.question)), *own]


def write(report: Report, folder: Path) -> None:
    """The statements and the tables of a report."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / STATEMENTS).write_text("\n".join([*report.headline, "", *sentences(report.html), ""]))
    for file, content in report.files().items():
        if file.endswith(".csv"):
            (folder / Path(file).name).write_bytes(content())


def write_all(out: Path, datasets: Path, only: list[str]) -> int:
    """Write what all reports say; 1 if one could not be made, whose error stands in place of its statements."""
    parts.draw = lambda *_, **__: parts.Drawn("<svg/>")  # drawing takes half of a report's time
    plans = {name: (datasets / name / name,) for name in PLANS} | {
        f"{first}_beside_{second}": (datasets / first / first, datasets / second / second)
        for first, second in COMPARED
    }
    n_failed = 0
    for name, places in plans.items():
        if only and name not in only:
            continue
        try:
            write(reporting.compared(*places) if places[1:] else reporting.report(places[0], _answers), out / name)
        except Exception as error:  # noqa: BLE001  each is told, and the others are written
            n_failed += 1
            (out / name).mkdir(parents=True, exist_ok=True)
            (out / name / STATEMENTS).write_text(f"{type(error).__name__}: {error}\n")
            print(f"{name}: {type(error).__name__}: {error}", file=sys.stderr)
    return int(n_failed > 0)


def by_value(text: str) -> str:
    """A line with each of its numbers as the shortest text of its value, to nine digits: what rounding leaves."""
    return _NUMBER.sub(lambda number: format(float(number[0].replace("\u2212", "-")), ".9g"), text)


def differences(old: Path, new: Path) -> list[str]:
    """What differs between two folders of `write`, by file: lines, - of the old, + of the new."""
    lines = []
    for name in sorted({file.name for folder in (old, new) for file in folder.iterdir()}):
        texts = [(folder / name).read_text() if (folder / name).exists() else "" for folder in (old, new)]
        versions = [[by_value(line) for line in text.splitlines()] for text in texts]
        _, _, *changes = difflib.unified_diff(*versions, n=0, lineterm="") if versions[0] != versions[1] else "  "
        lines += [f"{line[0]} {name}: {line[1:]}" for line in changes if not line.startswith("@@")]
    return lines


def compare(old: Path, new: Path) -> int:
    """Print what differs, by dataset; 1 if anything does."""
    n_different = 0
    names = sorted({file.parent.name for folder in (old, new) for file in folder.glob(f"*/{STATEMENTS}")})
    for name in names:
        folders = (old / name, new / name)
        if not all(folder.exists() for folder in folders):
            lines = ["-" if folders[0].exists() else "+"]
        else:
            lines = differences(*folders)
        n_different += bool(lines)
        if lines:
            print(f"== {name}: {len(lines)} lines", *lines, sep="\n")
    print(f"{n_different} of {len(names)} datasets differ")
    return int(n_different > 0)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.statements",
        description=statements.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("out", nargs="?", type=Path, help="where to write")
    parser.add_argument("--datasets", type=Path, help="where the datasets are, or are made")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="only these")
    parser.add_argument("--new", action="store_true", help="make the datasets anew")
    parser.add_argument("--compare", nargs=2, type=Path, metavar=("OLD", "NEW"))
    arguments = parser.parse_args(argv)
    if arguments.compare:
        return compare(*arguments.compare)
    if arguments.out is None or arguments.datasets is None:
        parser.error("expected OUT and --datasets DIR, or --compare OLD NEW")
    matplotlib.use("agg")
    for name, plan in PLANS.items():
        if arguments.only and name not in arguments.only:
            continue
        if arguments.new:
            shutil.rmtree(arguments.datasets / name, ignore_errors=True)
        if not (arguments.datasets / name).exists():
            print(f"run {name}", flush=True)
            make(name, plan, arguments.datasets)
    return write_all(arguments.out, arguments.datasets, arguments.only)


if __name__ == "__main__":
    sys.exit(main())
