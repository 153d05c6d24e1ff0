"""Damaged files of systems: read right, or refused in a line; none crashes, hangs or fills a process.

`python -m pytest -s -m long tests/pipeline/test_damaged_systems.py` tries 1,000 and counts what came of each kind.
"""

from __future__ import annotations

from collections import Counter

import pytest

from stickslip.pipeline.machine.processes import Child
from tests.damaged import DAMAGE, NO_FILES, judge

N_KINDS = len(DAMAGE | NO_FILES)


@pytest.mark.parametrize("n_files", [3 * N_KINDS, pytest.param(250, marks=pytest.mark.long)])
def test_a_damaged_file_is_read_right_or_refused_in_a_line(n_files, random_seed, tmp_path):
    kinds = [*DAMAGE, *NO_FILES]
    counts = {kind: Counter() for kind in kinds}
    with Child(shows_errors=True) as child:
        for number in range(n_files):
            folder = tmp_path / str(number)
            folder.mkdir()
            print("case", number, kinds[number % N_KINDS])
            counts[kinds[number % N_KINDS]][child(judge, (random_seed, number, str(folder)))] += 1
    for kind, count in counts.items():
        print(f"{kind:20}", dict(count))
    assert sum(count["refused"] for count in counts.values()) > n_files / 3
    if n_files > 3 * N_KINDS:  # of few files all may show that they are damaged
        assert sum(count["as it was"] for count in counts.values()) > 0
