"""Planted ensembles: series whose cascade law is known before anything is computed."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis import AnalysisSettings
from stickslip.analysis.page import parts
from tests.chance import SURE

T_END = 1000.0


def alternating_runs(rng, n_steps, gamma, t_end=T_END, level=100):
    """Runs of exits and of entries by turns, lengths from P(k) = (1 - q) q^(k-1), q = exp(-gamma), random times.

    Cut after `n_steps`, so that gamma = ln 2 is a fair coin at every step; below it exits bring on exits.
    """
    lengths = rng.geometric(1 - np.exp(-gamma), n_steps)
    signs = rng.choice([-1, 1]) * (-1) ** np.arange(n_steps)
    steps = np.repeat(signs, lengths)[:n_steps]
    t = np.sort(rng.uniform(0, t_end, n_steps))
    path = np.concatenate(([0], np.cumsum(steps)))
    return np.concatenate(([0.0], t)), max(level, -path.min()) + path  # never fewer than no block


def member(member_id, matrix, **changes):
    """One row of the members table, finished under Coulomb's law unless told otherwise."""
    row = {
        "member_id": member_id, "n": 200, "coupling": "antisymmetric", "matrix": matrix, "perturbation_size": 0.0,
        "engine": "coulomb", "tol": 1e-10, "eps": None, "ratio": None, "rtol": None, "atol": None, "stick": None,
        "threshold": None, "belt_speed": -0.2, "kappa": 0.2, "rho": 0.1, "t_end": T_END, "outcome": "finished",
        "reason": "", "t_stop": T_END, "n_stick_end": 30, "n_events": 10, "n_entries": 5, "n_exits": 5,
        "n_crossings": 0, "n_steps": 100, "n_rejected": 1, "n_products": 400,
    }  # fmt: skip
    return row | changes


SIGMOID = {
    "engine": "sigmoid", "tol": None, "eps": 0.03, "ratio": "uniform", "rtol": 1e-6, "atol": 1e-8,
    "stick": "convergent",
}  # fmt: skip


def ensemble(gammas, n_matrices, n_steps=1600, seed=0):
    """Members and series: for each (engine, gamma) of `gammas` one run a matrix."""
    rows, series = [], {}
    for engine, gamma in gammas.items():
        for matrix in range(n_matrices):
            rng = np.random.default_rng([seed, matrix, len(engine)])
            member_id = f"{engine}-{matrix:03d}"
            rows.append(member(member_id, matrix, **(SIGMOID if engine == "sigmoid" else {})))
            series[member_id] = alternating_runs(rng, n_steps, gamma)
    return pd.DataFrame(rows), series


@pytest.fixture
def settings():
    return AnalysisSettings(t_burn=100.0, dt=(0.5, 2.0), resamples=20, confidence=0.95, seed=0)


@pytest.fixture
def strict(settings):
    """At 0.95 one planted ensemble in twenty has what nobody planted, or lacks what is there."""
    return replace(settings, confidence=SURE)


@pytest.fixture
def planted():
    """The builders above, for tests that compose their own ensembles."""
    return SimpleNamespace(ensemble=ensemble, member=member, runs=alternating_runs, sigmoid=SIGMOID, t_end=T_END)


@pytest.fixture
def undrawn(request, monkeypatch):
    """Half of a report's time is drawing, which a few tests look at and the others leave out."""
    if "drawn" not in request.keywords:
        monkeypatch.setattr(parts, "draw", lambda *_, **__: parts.Drawn("<svg/>"))
