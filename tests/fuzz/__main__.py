"""Draw and judge until the time is up; see `tests.fuzz`."""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from itertools import count, product

import numpy as np

from tests import fuzz
from tests.fuzz.draw import draw, sort_of
from tests.fuzz.judge import LIMIT, Verdict
from tests.fuzz.relations import RELATIONS, setup_of
from tests.fuzz.workers import JUDGES, verdicts, within_limits
from tests.systems import TERMS


class _Table:
    """By engine: cases, errors, what failed."""

    def __init__(self) -> None:
        self._errors: dict[str, list[tuple[float, int]]] = {engine: [] for engine in LIMIT}
        self._notes: dict[str, Counter[str]] = {engine: Counter() for engine in LIMIT}

    def add(self, engine: str, number: int, verdict: Verdict) -> None:
        if not verdict.notes["skipped"]:
            self._errors[engine].append((verdict.worst, number))
        self._notes[engine].update(verdict.notes, failed=int(bool(verdict.failures)))

    def __str__(self) -> str:
        lines = [f"{'':8} cases   error over tol times sensitivity: 95% below, worst, its case; what came of series"]
        for engine, errors in self._errors.items():
            if not errors:
                continue
            high, (worst, number) = np.quantile([error for error, _ in errors], 0.95), max(errors)
            notes = ", ".join(f"{n} {kind}" for kind, n in sorted(self._notes[engine].items()) if n)
            lines.append(f"{engine:8} {len(errors):5} {high:12.3g} {worst:12.3g} {number:8}   {notes}")
        return "\n".join(lines)


class _Relations:
    """By family and engine: checks, what came of them, the worst ratio of those that hold."""

    def __init__(self) -> None:
        self._kinds: dict[tuple[str, str], Counter[str]] = {pair: Counter() for pair in product(RELATIONS, LIMIT)}
        self._worst: Counter[tuple[str, str]] = Counter()

    def add(self, engine: str, verdict: Verdict) -> None:
        for family, kind, ratio in verdict.relations:
            self._kinds[family, engine][kind] += 1
            if kind != "differs":
                self._worst[family, engine] = max(self._worst[family, engine], ratio)

    def __str__(self) -> str:
        lines = [f"{'relation':12} {'engine':8} checks   worst of those that hold; what came of them"]
        for (family, engine), kinds in self._kinds.items():
            words = ", ".join(f"{n} {kind}" for kind, n in sorted(kinds.items()))
            lines.append(f"{family:12} {engine:8} {kinds.total():6} {self._worst[family, engine]:12.3g}   {words}")
        return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    """0 if the exact engine was right throughout, and every relation held."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz", description=fuzz.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=1.0, help="how long to draw")
    parser.add_argument("--seed", type=int, default=None, help="a new one if left out; printed first")
    parser.add_argument("--case", type=int, default=None, help="only this one, shown")
    parser.add_argument("--terms", nargs="+", choices=(*TERMS, "none"), default=TERMS, metavar="TERM",
                        help=f"what to draw beside eq. (10): {', '.join(TERMS)}; none; all if left out")  # fmt: skip
    parser.add_argument("--against", nargs="+", choices=JUDGES, default=list(JUDGES), metavar="JUDGE",
                        help=f"what to hold cases against: {', '.join(JUDGES)}; in turn, if left out")  # fmt: skip
    arguments = parser.parse_args(argv)
    seed = int(np.random.SeedSequence().generate_state(1)[0]) if arguments.seed is None else arguments.seed
    print(f"seed {seed}", flush=True)
    if arguments.case is not None:
        print(draw(seed, arguments.case, arguments.terms).words())
        print(setup_of(seed, arguments.case, arguments.terms))
    numbers = count() if arguments.case is None else [arguments.case]
    cases = ((seed, number, arguments.terms, against) for number in numbers for against in arguments.against)
    table, relations, n_wrong, n_cases = _Table(), _Relations(), 0, 0
    start = told = time.monotonic()
    for case, verdict in verdicts(within_limits, cases, start + 60 * arguments.minutes):
        _, number, _, against = case
        family, engine = sort_of(number)  # all else of it takes as long to draw as a run
        if against == "reference":
            table.add(engine, number, verdict)
        else:
            relations.add(engine, verdict)
        n_cases += 1
        n_wrong += bool(verdict.failures) and (engine == "coulomb" or against == "relations")
        if verdict.failures:
            print(f"--seed {seed} --case {number} --against {against}: {engine}, {family}")
            print("".join(f"    {words}\n" for words in verdict.failures), end="", flush=True)
        if time.monotonic() > told + 60:
            told = time.monotonic()
            print(f"{(told - start) / 60:.0f} min\n{table}\n{relations}", flush=True)
    taken = time.monotonic() - start
    beyond = ", ".join(f"{limit:g} ({engine})" for engine, limit in LIMIT.items())
    print(f"\n{table}\n{relations}\n{n_cases} cases in {taken:.0f} s; seed {seed}; a run is wrong beyond {beyond}")
    return 1 if n_wrong else 0


if __name__ == "__main__":
    sys.exit(main())
