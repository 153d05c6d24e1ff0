"""What holds for all tests."""

import hashlib
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


def pytest_addoption(parser):
    parser.addoption("--fresh", action="store_true", help="only the tests that draw at random, on a new seed")
    parser.addoption("--seed", type=int, help="as --fresh, on the seed that such a run has printed")


def pytest_configure(config):
    """One number decides what a run draws; pytest-xdist hands it to its workers with the other options."""
    option = config.option
    option.fresh |= option.seed is not None
    if option.seed is None:
        option.seed = secrets.randbits(32)
    # none looks at the clock
    settings.register_profile(
        "any machine", deadline=None, print_blob=True, database=None, derandomize=not option.fresh
    )
    settings.load_profile("any machine")


def pytest_collection_modifyitems(config, items):
    if config.option.fresh:
        seeds = {"random_seed", "module_seed"}
        draws = {item: seeds & {*item.fixturenames} or item.get_closest_marker("hypothesis") for item in items}
        config.hook.pytest_deselected(items=[item for item in items if not draws[item]])
        items[:] = [item for item in items if draws[item]]


def pytest_terminal_summary(terminalreporter, config):
    if config.option.fresh:
        terminalreporter.write_line(f"to draw the same again: --seed {config.option.seed}")


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


def _seed(request):
    is_fresh = request.config.option.fresh or "long" in request.keywords
    name = f"{request.config.option.seed if is_fresh else ''} {request.node.nodeid}"
    seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:4])
    print("seed", seed)
    return seed


@pytest.fixture
def random_seed(request):
    """A seed that the test's name fixes; with `--fresh`, and in long tests, one of this run, which is printed."""
    return _seed(request)


@pytest.fixture(scope="module")
def module_seed(request):
    """The same for what the tests of a file share."""
    return _seed(request)


@pytest.fixture
def rng(random_seed):
    """Random numbers from the seed of the test."""
    return np.random.default_rng(random_seed)
