"""What holds for all tests."""

import hashlib
import os
import random
import secrets
import signal
import time

from stickslip.pipeline.machine.processes import ONE_THREAD

os.environ.update(
    ONE_THREAD
)  # before anything loads numpy: pytest's workers fill the cores, and threads wait for them

import hypothesis
import numpy as np
import pytest
from hypothesis import HealthCheck, settings

_DEADLINE = pytest.StashKey[float]()
_TIME_IS_UP = "left out: the time of this sample was up"


def pytest_addoption(parser):
    parser.addoption("--fresh", action="store_true", help="only the tests that draw at random, on a new seed")
    parser.addoption("--repeat", type=int, help="as --fresh, and each test so many times, each on a seed of its own")
    parser.addoption("--seed", type=int, help="as --fresh or `-m long`, on the seed that such a run has printed")
    parser.addoption("--minutes", type=float, help="a random sample of the tests, of this duration")


def pytest_configure(config):
    """One number decides what a run draws, and what its workers draw."""
    option = config.option
    option.fresh |= option.repeat is not None or (option.seed is not None and option.markexpr != "long")
    if option.seed is None:
        option.seed = getattr(config, "workerinput", {}).get("seed") or secrets.randbits(32)
    # none looks at the clock
    settings.register_profile(
        "any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True, database=None
    )
    settings.load_profile("any machine")


def _draws(test):
    return "repetition" in test.fixturenames or hypothesis.is_hypothesis_test(test.function)


def pytest_generate_tests(metafunc):
    if metafunc.config.option.fresh and _draws(metafunc):
        if "repetition" not in metafunc.fixturenames:
            metafunc.fixturenames.append("repetition")
        metafunc.parametrize("repetition", range(metafunc.config.option.repeat or 1), scope="module")


def pytest_collection_modifyitems(config, items):
    if config.option.fresh:
        config.hook.pytest_deselected(items=[item for item in items if not _draws(item)])
        items[:] = [item for item in items if _draws(item)]
    if config.option.minutes is not None:
        random.Random(config.option.seed).shuffle(items)


def pytest_collection_finish(session):
    minutes = session.config.option.minutes
    session.stash[_DEADLINE] = float("inf") if minutes is None else time.monotonic() + 60 * minutes


def pytest_runtest_setup(item):
    if time.monotonic() > item.session.stash[_DEADLINE]:
        pytest.skip(_TIME_IS_UP)
    if hypothesis.is_hypothesis_test(item.obj):
        hypothesis.seed(_seed(item))(item.obj)


def pytest_terminal_summary(terminalreporter, config):
    """How much of a sample ran, and how to draw the same again."""
    option, stats = config.option, terminalreporter.stats
    if option.minutes is not None:
        ends = [report for kind in ("passed", "failed", "error", "skipped") for report in stats.get(kind, [])]
        tests = {report.nodeid for report in ends}
        left = {report.nodeid for report in stats.get("skipped", []) if _TIME_IS_UP in str(report.longrepr)}
        terminalreporter.write_line(f"{len(tests) - len(left)} of {len(tests)} tests ran in {option.minutes:g} min")
    if option.fresh or option.markexpr == "long":
        repeat = f" --repeat {option.repeat}" if option.repeat else ""
        terminalreporter.write_line(f"to draw the same again: --seed {option.seed}{repeat}")


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node):
    node.workerinput["seed"] = node.config.option.seed


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Tests of a file stay with one worker, as far as both have work: then one alone makes what they share."""
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log) if config.getvalue("dist") == "load" else None


@pytest.fixture(autouse=True, scope="session")
def answers_to_signals():
    """What a shell puts into the background is deaf to SIGINT, and under nohup to SIGHUP; tests, and what they start,
    are not."""
    handlers = {signal.SIGINT: signal.default_int_handler, signal.SIGHUP: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def _seed(node, repetition=""):
    option = node.config.option
    is_fresh = option.fresh or node.get_closest_marker("long") is not None  # keywords have names of folders too
    name = f"{option.seed if is_fresh else ''}{repetition} {node.nodeid}"
    seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:4])
    print("seed", seed)
    return seed


@pytest.fixture(scope="module")
def repetition():
    """Which repetition of a test this is; `--repeat` gives it values."""
    return ""


@pytest.fixture
def random_seed(request, repetition):
    """A seed that the test's name fixes; with `--fresh`, and in long tests, one of this run, which is printed."""
    return _seed(request.node, repetition)


@pytest.fixture(scope="module")
def module_seed(request, repetition):
    """The same for what the tests of a file share."""
    return _seed(request.node, repetition)


@pytest.fixture
def rng(random_seed):
    """Random numbers from the seed of the test."""
    return np.random.default_rng(random_seed)
