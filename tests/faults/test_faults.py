"""The quick subset of the faults; `python -m tests.faults --all` makes them all."""

import pytest

from tests.faults.__main__ import _UNSHOWN, attempt
from tests.faults.registry import FAULTS


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name, fault in FAULTS.items() if fault.quick])
def test_fault(name):
    code, words = attempt(name, FAULTS[name].quick, seed=0, timeout=400.0)
    if code == _UNSHOWN:
        pytest.skip(words)
    assert code == 0, words
