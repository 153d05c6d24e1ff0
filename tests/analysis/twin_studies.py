"""Planted studies of comparisons, which the guide shows.

cd tests/analysis && python -c "import twin_studies; twin_studies.main()"    # a few minutes
"""

import numpy as np
from scipy import stats

from stickslip.analysis.pairs import Change, Comparison, Pair
from stickslip.analysis.stats.cascades import window
from stickslip.analysis.stats.compare import (
    DIFFERENT,
    EQUIVALENT,
    equivalence_test,
    power,
    share_over_matrices,
    verdict,
)
from stickslip.analysis.stats.estimates import jackknife
from stickslip.analysis.stats.robustness import distribution_test, time_shares
from stickslip.analysis.stats.sensitivity import growth

#: n = 200, exact law, t = 600 to 1000, 20 matrices, constants changed by 1 to 10%: spread over matrices of the base,
#: and of the paired difference, both relative to the base; and a margin.
OBSERVED = {
    "mean": (0.07, 0.08, 0.10), "variance": (0.45, 0.53, 0.25), "rate": (0.057, 0.067, 0.10),
    "gamma": (0.025, 0.030, 0.05),
}  # fmt: skip
ALPHA = 0.05


def verdicts(quantity, true_difference, n_matrices=20, ensembles=10_000, seed=0):
    """Shares of the verdicts where a relative difference is planted: skewed values of the observed spread."""
    base_spread, spread, margin = OBSERVED[quantity]
    rng = np.random.default_rng([seed, list(OBSERVED).index(quantity)])
    # values of base and changed are gamma-distributed about the matrix's own, so that their difference has `spread`
    within = spread / np.sqrt(2)
    between = np.sqrt(max(base_spread**2 - within**2, 0.0))
    found = []
    for _ in range(ensembles):
        own = np.clip(1 + between * rng.standard_normal(n_matrices), 0.1, None)
        base, changed = rng.gamma(1 / within**2, within**2, (2, n_matrices)) * own
        sums = np.column_stack([changed * (1 + true_difference), base])
        difference, error = jackknife(lambda s: s[:, 0] / s[:, 1] - 1, sums)
        test = equivalence_test(difference, error, n_matrices - 1, margin)
        found.append(verdict(test.p_equivalent, test.p_different, ALPHA))
    return {name: found.count(name) / ensembles for name in (EQUIVALENT, DIFFERENT)}


def oscillating(rng, t_end=400.0, dt=0.5, period=25.0, decay=60.0, spread=5.0, level=32.0, shift=0.0):
    """n_stick like that of 200 blocks: an oscillation whose phase holds for `decay` units, over a fast part."""
    m = int(t_end / dt)
    factor = np.exp((-1 / decay + 2j * np.pi / period) * dt)
    noise = (rng.standard_normal(m) + 1j * rng.standard_normal(m)) * np.sqrt(1 - abs(factor) ** 2)
    slow = np.empty(m, complex)
    slow[0] = rng.standard_normal() + 1j * rng.standard_normal()
    for k in range(1, m):
        slow[k] = factor * slow[k - 1] + noise[k]
    drift = np.empty(m)  # and a slow wander, of the length of the window
    drift[0] = rng.standard_normal()
    hold = np.exp(-dt / decay)
    for k in range(1, m):
        drift[k] = hold * drift[k - 1] + np.sqrt(1 - hold**2) * rng.standard_normal()
    fast = rng.standard_normal(m)
    values = level + shift + spread * (0.6 * slow.real + 0.4 * drift + 0.69 * fast)
    return window(np.arange(m) * dt, np.clip(np.rint(values), 0, 200).astype(int), 0.0, t_end)


def distance_verdicts(shift=0.0, margin=1.25, ensembles=2000, n_matrices=20, seed=0, pool=1500):
    """Shares of p < alpha, for different and for equivalent, of the distributions' test; runs drawn from a pool."""
    rng = np.random.default_rng([seed, int(100 * shift)])
    base = np.array([time_shares(oscillating(rng), 200) for _ in range(pool)])
    changed = np.array([time_shares(oscillating(rng, shift=shift), 200) for _ in range(pool)])
    found = np.zeros(2)
    for _ in range(ensembles):
        some = rng.choice(pool, (2, n_matrices))
        test = distribution_test(changed[some[0]], base[some[1]], 1.0, margin, rng)
        found += [test.p_different < ALPHA, test.p_equivalent < ALPHA]
    return found / ensembles


def separations(rng, n_matrices=20, rate=0.012, spread=0.002, noise=0.3, t_end=1000.0):
    """Distances of displaced starts: exponential with a rate of each matrix, noise correlated over 20 units."""
    times = np.linspace(0, t_end, 251)
    rates = rate + spread * rng.standard_normal(n_matrices)
    hold = np.exp(-(times[1] - times[0]) / 20)
    found = {}
    for matrix in range(n_matrices):
        wander = np.zeros(len(times))
        for k in range(1, len(times)):
            wander[k] = hold * wander[k - 1] + noise * np.sqrt(1 - hold**2) * rng.standard_normal()
        found[f"t{matrix}"] = times, 1e-10 * np.exp(rates[matrix] * times + wander)
    pairs = tuple(Pair(matrix, f"b{matrix}", f"t{matrix}") for matrix in range(n_matrices))
    return Comparison("planted", Change("start", None, 1e-10), pairs), found


def growth_coverage(ensembles=1000, seed=0, rate=0.012):
    """Share of ensembles whose 95% interval of the growth rate holds the mean rate."""
    rng = np.random.default_rng([seed, 3])
    hits = 0
    for _ in range(ensembles):
        comparison, found = separations(rng, rate=rate)
        estimate = growth(comparison, found, 1e-2, 0.95).rate
        hits += estimate.low <= rate <= estimate.high
    return hits / ensembles


def share_coverage(share=0.3, n_matrices=20, draws=3, concentration=2.0, ensembles=5000, seed=0):
    """Coverage of the interval of a share where runs of one matrix agree: a beta distribution between matrices."""
    rng = np.random.default_rng([seed, 4])
    own = rng.beta(share * concentration, (1 - share) * concentration, (ensembles, n_matrices))
    counts = rng.binomial(draws, own)
    hits = 0
    for row in counts:
        _, low, high, _ = share_over_matrices(np.column_stack([row, np.full(n_matrices, draws)]), 0.95)
        hits += low <= share <= high
    return hits / ensembles


def main():
    for quantity, (_, spread, margin) in OBSERVED.items():
        at_margin = [verdicts(quantity, side * margin)[EQUIVALENT] for side in (1, -1)]
        none = verdicts(quantity, 0.0)
        print(quantity, "equivalent at +margin, -margin", at_margin, "at zero", none, "formula",
              round(power(20, spread, margin, ALPHA), 3), "alarms", _raw_alarm(quantity))  # fmt: skip
    for shift in (0.0, 1.25, 2.0, 4.0):
        print("distribution, shift", shift, distance_verdicts(shift))
    print("growth coverage", growth_coverage())
    print("share coverage", share_coverage(), share_coverage(share=0.1))


def _raw_alarm(quantity, ensembles=10_000):
    """How often p_different < alpha at no difference, equivalence left aside."""
    _, spread, _ = OBSERVED[quantity]
    rng = np.random.default_rng(5)
    within = spread / np.sqrt(2)
    hits = 0
    for _ in range(ensembles):
        sums = rng.gamma(1 / within**2, within**2, (20, 2))
        difference, error = jackknife(lambda s: s[:, 0] / s[:, 1] - 1, sums)
        hits += 2 * stats.t.sf(abs(difference) / error, 19) < ALPHA
    return hits / ensembles
