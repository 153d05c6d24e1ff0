"""What holds for all tests."""

import os
import secrets
import signal

from stickslip.pipeline.machine.processes import ONE_THREAD

os.environ.update(
    ONE_THREAD
)  # before anything loads numpy: pytest's workers fill the cores, and threads wait for them

import numpy as np
import pytest
from hypothesis import settings

settings.register_profile("any machine", deadline=None, print_blob=True)  # none looks at the clock
settings.load_profile("any machine")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Tests of a file stay with one worker, as far as both have work: then one alone makes what they share."""
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log) if config.getvalue("dist") == "load" else None


@pytest.fixture(autouse=True, scope="session")
def answers_to_ctrl_c():
    """A shell starts what it puts into the background deaf to SIGINT; tests, and what they start, are not."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def rng():
    """Random numbers from a seed that is new at each run, and printed."""
    seed = secrets.randbits(32)
    print("seed", seed)
    return np.random.default_rng(seed)
