"""Measuring: in a process of its own with one thread, and in units that hold on any machine."""

from __future__ import annotations

import json
import platform
import subprocess
import sys
import time
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stickslip.pipeline.processes import ONE_THREAD, environment, python
from stickslip.workflows.charts import ChartError, load_chart

#: A batch of products takes about so many seconds: long beside the clock, short beside the machine's moods.
_BATCH, _BATCHES = 3e-4, 5


class Product:
    """The unit of cost: one product of a matrix with a vector, by numpy (float64)."""

    def __init__(self, matrix: NDArray[np.float64]) -> None:
        self._matrix = np.ascontiguousarray(matrix)
        self._x, self._out = np.ones(len(matrix)), np.empty(len(matrix))
        self._n = 16
        while (seconds := self._batch()) < _BATCH:
            self._n = max(2 * self._n, int(self._n * _BATCH / max(seconds, 1e-9)))

    def _batch(self) -> float:
        matrix, x, out = self._matrix, self._x, self._out
        start = time.perf_counter()
        for _ in range(self._n):
            np.dot(matrix, x, out=out)
        return time.perf_counter() - start

    def seconds(self) -> float:
        """Seconds of one product, now: the median of a few batches."""
        return median(self._batch() for _ in range(_BATCHES)) / self._n


def versions(*libraries: str) -> dict[str, str]:
    """What took part, by distribution; "not installed" for a library that is absent."""
    found = {"python": platform.python_version()}
    for name in ("stickslip", "numpy", "numba", *libraries):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def measure_alone(file: Path) -> Any:
    """Measure the chart of a scene file in a process of its own, with one thread; progress goes to stderr.

    One thread is set before the process starts: libraries of linear algebra read it when they load.

    Raises
    ------
    ChartError
        If that process ends early.
    """
    done = subprocess.run(
        [*python(), "-m", "stickslip.workflows.charts.alone", str(file)],
        env=environment() | ONE_THREAD, stdout=subprocess.PIPE, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        raise ChartError(f"the measurement ended with exit code {done.returncode}; its own words are above")
    kind, _ = load_chart(file)
    return kind.restore(json.loads(done.stdout))


def _main(file: str) -> int:
    def say(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    kind, scene = load_chart(Path(file))
    try:
        found = kind.measure(scene, say)
    except KeyboardInterrupt:  # the parent says so
        return 130
    json.dump(asdict(found), sys.stdout, allow_nan=False)
    return 0


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1]))
