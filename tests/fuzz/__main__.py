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
from tests.fuzz.relations import LIMIT as OF_RELATIONS
from tests.fuzz.relations import RELATIONS, setup_of
from tests.fuzz.workers import JUDGES, verdicts, within_limits
from tests.systems import TERMS


class _Table:
    """By method: cases, errors, what failed."""

    def __init__(self) -> None:
        self._errors: dict[str, list[tuple[float, int]]] = {method: [] for method in LIMIT}
        self._notes: dict[str, Counter[str]] = {method: Counter() for method in LIMIT}

    def add(self, method: str, number: int, verdict: Verdict) -> None:
        if not verdict.notes["skipped"]:
            self._errors[method].append((verdict.worst, number))
        self._notes[method].update(verdict.notes, failed=int(bool(verdict.failures)))

    def __str__(self) -> str:
        lines = [f"{'':8} cases   error over tol times sensitivity: 95% below, worst, its case; what came of series"]
        for method, errors in self._errors.items():
            if not errors:
                continue
            high, (worst, number) = np.quantile([error for error, _ in errors], 0.95), max(errors)
            notes = ", ".join(f"{n} {kind}" for kind, n in sorted(self._notes[method].items()) if n)
            lines.append(f"{method:8} {len(errors):5} {high:12.3g} {worst:12.3g} {number:8}   {notes}")
        return "\n".join(lines)


class _Relations:
    """By family and method: checks, what came of them, the worst ratio of those that hold."""

    def __init__(self) -> None:
        self._kinds: dict[tuple[str, str], Counter[str]] = {
            pair: Counter() for pair in product(RELATIONS, OF_RELATIONS)
        }
        self._worst: Counter[tuple[str, str]] = Counter()

    def add(self, method: str, verdict: Verdict) -> None:
        for family, kind, ratio in verdict.relations:
            self._kinds[family, method][kind] += 1
            if kind != "differs":
                self._worst[family, method] = max(self._worst[family, method], ratio)

    def __str__(self) -> str:
        lines = [f"{'relation':12} {'method':8} checks   worst of those that hold; what came of them"]
        for (family, method), kinds in self._kinds.items():
            if not kinds:
                continue
            words = ", ".join(f"{n} {kind}" for kind, n in sorted(kinds.items()))
            lines.append(f"{family:12} {method:8} {kinds.total():6} {self._worst[family, method]:12.3g}   {words}")
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
        method = "waves" if "waves" in against else engine
        if "relations" in against:
            relations.add(method, verdict)
        else:
            table.add(method, number, verdict)
        n_cases += 1
        n_wrong += bool(verdict.failures) and (method == "coulomb" or "relations" in against)
        if verdict.failures:
            print(f"--seed {seed} --case {number} --against {against}: {method}, {family}")
            print("".join(f"    {words}\n" for words in verdict.failures), end="", flush=True)
        if time.monotonic() > told + 60:
            told = time.monotonic()
            print(f"{(told - start) / 60:.0f} min\n{table}\n{relations}", flush=True)
    taken = time.monotonic() - start
    beyond = ", ".join(f"{limit:g} ({method})" for method, limit in LIMIT.items())
    print(f"\n{table}\n{relations}\n{n_cases} cases in {taken:.0f} s; seed {seed}; a run is wrong beyond {beyond}")
    return 1 if n_wrong else 0


if __name__ == "__main__":
    sys.exit(main())
