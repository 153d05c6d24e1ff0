"""What holds for all tests."""

import signal

import pytest


@pytest.fixture(autouse=True, scope="session")
def answers_to_ctrl_c():
    """A shell starts what it puts into the background deaf to SIGINT; tests, and what they start, are not."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
