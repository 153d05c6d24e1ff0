"""Draw and judge until the time is up; see `tests.fuzz`."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter, defaultdict
from functools import partial
from itertools import count

import numpy as np

from tests import fuzz
from tests.fuzz.draw import FAMILIES, TERMS, draw
from tests.fuzz.judge import LIMIT, Verdict
from tests.fuzz.workers import judge_case, verdicts


class _Table:
    """By engine and family: cases, errors, what failed."""

    def __init__(self) -> None:
        self._errors: dict[tuple[str, str], list[tuple[float, int]]] = defaultdict(list)
        self._failed: Counter[tuple[str, str]] = Counter()
        self._notes: dict[str, Counter[str]] = defaultdict(Counter)

    def add(self, engine: str, family: str, number: int, verdict: Verdict) -> None:
        if not verdict.notes["skipped"]:
            self._errors[engine, family].append((verdict.worst, number))
        self._failed[engine, family] += bool(verdict.failures)
        self._notes[engine].update(verdict.notes)

    def __str__(self) -> str:
        lines = [f"{'':24} cases   failed   error over tol times sensitivity: 95% below, worst, its case"]
        for engine in ("coulomb", "sigmoid"):
            rows = {family: errors for (name, family), errors in sorted(self._errors.items()) if name == engine}
            rows["all"] = [error for errors in rows.values() for error in errors]
            for family, errors in rows.items():
                failed = sum(n for key, n in self._failed.items() if key[0] == engine and family in (key[1], "all"))
                if errors:
                    high, (worst, number) = np.quantile([error for error, _ in errors], 0.95), max(errors)
                    lines.append(
                        f"{engine:8} {family:15} {len(errors):5} {failed:8}   {high:12.3g} {worst:12.3g} {number:8}"
                    )
            notes = ", ".join(f"{n} {kind}" for kind, n in sorted(self._notes[engine].items()) if n)
            lines.append(f"{engine:8} series of blocks and cases: {notes}")
        return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    """0 if the exact engine was right throughout."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz", description=fuzz.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=1.0, help="how long to draw")
    parser.add_argument("--cases", type=int, default=None, help="how many to draw at most")
    parser.add_argument("--seed", type=int, default=None, help="a new one if left out; printed first")
    parser.add_argument("--case", type=int, default=None, help="only this one, shown")
    parser.add_argument("--families", nargs="+", choices=FAMILIES, default=list(FAMILIES), metavar="NAME",
                        help=", ".join(FAMILIES))  # fmt: skip
    parser.add_argument("--terms", nargs="*", choices=TERMS, default=TERMS, metavar="TERM",
                        help=f"what may be drawn beside eq. (10): {', '.join(TERMS)}; all if left out")  # fmt: skip
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args(argv)
    seed = int(np.random.SeedSequence().generate_state(1)[0]) if arguments.seed is None else arguments.seed
    print(f"seed {seed}", flush=True)
    if arguments.case is not None:
        print(draw(seed, arguments.case, arguments.terms).words())
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    wanted = [list(FAMILIES).index(family) for family in arguments.families]
    every = count() if arguments.case is None else iter([arguments.case])
    numbers = (k for k in every if arguments.case is not None or k % len(FAMILIES) in wanted)
    if arguments.cases is not None:
        numbers = (k for k, _ in zip(numbers, range(arguments.cases), strict=False))
    table, n_wrong, n_cases = _Table(), 0, 0
    start = time.monotonic()
    judged, until = partial(judge_case, seed, terms=arguments.terms), start + 60 * arguments.minutes
    for number, verdict in verdicts(judged, numbers, arguments.workers, until):
        trial = draw(seed, number, arguments.terms)
        table.add(trial.engine, trial.family, number, verdict)
        n_cases += 1
        n_wrong += bool(verdict.failures) and trial.engine == "coulomb"
        if verdict.failures:
            print(f"--seed {seed} --case {number}: {trial.engine}, {trial.family}, n = {trial.case.n}")
            print("".join(f"    {words}\n" for words in verdict.failures), end="", flush=True)
    taken = time.monotonic() - start
    beyond = ", ".join(f"{limit:g} ({engine})" for engine, limit in LIMIT.items())
    print(f"\n{table}\n{n_cases} cases in {taken:.0f} s; seed {seed}; a run is wrong beyond {beyond}")
    return 1 if n_wrong else 0


if __name__ == "__main__":
    sys.exit(main())
