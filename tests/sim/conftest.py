"""Small systems try what only large ones take."""

import numpy as np
import pytest

from stickslip.sim.engines.coulomb.settings import Coulomb


@pytest.fixture(autouse=True)
def arrays_as_stored(monkeypatch):
    """K is run as it is stored, so that a sparse array of few blocks has local updates."""
    monkeypatch.setattr(Coulomb, "is_sparse", staticmethod(lambda s, _: not isinstance(s.stiffness, np.ndarray)))
