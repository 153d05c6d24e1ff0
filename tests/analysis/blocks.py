"""Two-state blocks as an ensemble."""

import numpy as np
import pandas as pd

from stickslip.analysis import AnalysisSettings, Study
from tests.analysis import studies
from tests.analysis.designs import Data


def coupled_blocks(planted, n, pull, rng, matrices=8, changes=3000):
    """Two-state blocks as an ensemble, for each of some n; 0.3 n stick."""
    rows, series, events = [], {}, {}
    for size in n:
        for matrix, (win, steps) in enumerate(studies.two_state_blocks(rng, size, 0.3, pull, changes, matrices)):
            name = f"{size}-{matrix}"
            rows.append(planted.member(name, matrix, n=size, t_end=win.t_stop, t_stop=win.t_stop))
            sticks = np.zeros(size, dtype=bool)
            blocks, first = np.unique(steps.block, return_index=True)
            sticks[blocks] = steps.step[first] < 0
            sticks[np.setdiff1d(np.arange(size), blocks)[: win.level - sticks.sum()]] = True
            series[name] = np.append(0.0, win.t), win.path()
            mode = np.where(steps.step > 0, 0, 1).astype(np.int8)
            events[name] = steps.t, steps.block, mode, np.where(sticks, 0, 1).astype(np.int8)
    members = pd.DataFrame(rows)
    members["t_end"] = members["t_end"].min()
    settings = AnalysisSettings(1.0, (0.5,), 10, 0.95, 0)
    return Study(Data(members, series, events), settings)
