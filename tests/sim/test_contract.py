"""What every engine promises, on all that are registered."""

import pytest

from stickslip.sim.engines import ENGINES
from tests.sim.contract import require_rules


@pytest.mark.parametrize("name", ENGINES)
def test_each_engine_keeps_the_rules(name, rng):
    require_rules(name, rng)
