"""How tests judge what chance decides, so that right code fails once in a million times, whatever its seeds.

One rule for all: shares by `agrees`, means by `ERRORS`, intervals asked for at the confidence `SURE`.
"""

from scipy import stats

RARE = 1e-6
SURE = 1 - RARE
#: Standard errors by which a mean is off more rarely: 4.9.
ERRORS = float(stats.norm.isf(RARE / 2))


def agrees(n_hits: int, n: int, low: float, high: float | None = None) -> bool:
    """Whether `n_hits` of `n` independent trials may come of a probability from `low` to `high`, by default `low`."""
    too_few = stats.binom.cdf(n_hits, n, low) <= RARE
    too_many = stats.binom.sf(n_hits - 1, n, low if high is None else high) <= RARE
    return not (too_few or too_many)
