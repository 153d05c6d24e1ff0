"""Damaged files of systems: read right, or refused in a line; none crashes or hangs the process, or fills its memory."""

from __future__ import annotations

import secrets
from collections import Counter

import pytest

from stickslip.pipeline.processes import Child
from tests.damaged import DAMAGE, NO_FILES, judge

N_KINDS = len(DAMAGE | NO_FILES)


def answer(case):
    """What came of a case, as text: a child that raises would say nothing."""
    try:
        return judge(case)
    except Exception as error:
        return f"{type(error).__name__}: {error}"


@pytest.mark.parametrize("n_files", [3 * N_KINDS, pytest.param(1000, marks=pytest.mark.long)])
def test_a_damaged_file_is_read_right_or_refused_in_a_line(n_files, tmp_path):
    seed = secrets.randbits(32)
    print("seed", seed)
    kinds = [*DAMAGE, *NO_FILES]
    counts = {kind: Counter() for kind in kinds}
    with Child(answer) as child:
        for number in range(n_files):
            folder = tmp_path / str(number)
            folder.mkdir()
            found = child((seed, number, str(folder)))
            assert found in ("refused", "as it was", "another"), f"case {number} of seed {seed}: {found}"
            counts[kinds[number % N_KINDS]][found] += 1
    for kind, count in counts.items():
        print(f"{kind:20}", dict(count))
    assert sum(count["refused"] for count in counts.values()) > n_files / 3
    assert sum(count["as it was"] for count in counts.values()) > 0
