"""Published claims, judged by measurements: facts and verdicts, which a chart's template puts into words.

One rule (`told`): a claim says that a number lies in a region. It is reproduced if the whole 95% interval does, not
reproduced if none of it does, and else cannot be told. It is corrected if it is not reproduced, but is after a change
that is named. So is what is said to make no difference (`alike`): the region is the margin to both sides of none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.stats.shares import wilson

REPRODUCED, CORRECTED, CONTRADICTED, UNTOLD = "reproduced", "corrected", "not reproduced", "cannot be told"
CONFIDENCE = 0.95
_TABLE: Mapping[str, Any] = {
    "claim": "string", "figure": "Int64", "verdict": "string", "found": "Int64", "tried": "Int64", "value": "Float64",
    "low": "Float64", "high": "Float64",
}  # fmt: skip
#: The name of a claim, its `verdict`, and the facts that its words need.
Claim = dict[str, Any]


def judged(claims: Iterable[Callable[..., Claim]], *measured: Any) -> list[Claim]:
    """Each claim as a function judges it by what was measured."""
    return [{"claim": claim.__name__} | claim(*measured) for claim in claims]


def table(claims: Sequence[Claim]) -> pd.DataFrame:
    """The claims in numbers: `found` of `tried`, or a `value`, each with its interval."""
    columns = {name: [claim.get(name) for claim in claims] for name in _TABLE}
    return pd.DataFrame(columns).astype(_TABLE)


def verdict_of(is_so: bool, otherwise: str = CONTRADICTED) -> str:
    """Of a claim without an interval."""
    return REPRODUCED if is_so else otherwise


def told(
    low: float | None, high: float | None, least: float = -np.inf, most: float = np.inf, otherwise: str = CONTRADICTED
) -> str:
    """Whether the interval lies in [least, most]: the rule of this module."""
    if low is None or high is None:
        return UNTOLD
    if least <= low and high <= most:
        return REPRODUCED
    return otherwise if high < least or low > most else UNTOLD


def alike(estimate: Estimate, margin: float) -> str:
    """Whether a difference is none, to within a margin."""
    return told(estimate.low, estimate.high, -margin, margin)


def every(verdicts: Sequence[str]) -> str:
    """Of claims that all have to hold."""
    return next((verdict for verdict in (CONTRADICTED, CORRECTED, UNTOLD) if verdict in verdicts), REPRODUCED)


def numbers(estimate: Estimate) -> Claim:
    """A `value` with its interval."""
    return {"value": estimate.value, "low": estimate.low, "high": estimate.high}


def share(hits: int, tried: int) -> Claim:
    """So many of so many independent ones, with the interval of the share; null if there are none."""
    low, high = wilson(hits, tried, CONFIDENCE) if tried else (None, None)
    return {"found": hits, "tried": tried, "low": low, "high": high}
