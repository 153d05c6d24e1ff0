"""Planted ensembles for the law of cascades, and the studies that the guide's page on them shows.

`python tests/analysis/law_studies.py` runs the studies in full, in some minutes.
"""

import numpy as np
from scipy import optimize, signal, stats

from stickslip.analysis.stats.families import (
    EXPONENTIAL,
    LOGNORMAL,
    POWER_LAW,
    RIVALS,
    log_shares,
    maximise,
    truncate,
)
from stickslip.analysis.stats.goodness import between_share, goodness, rate
from stickslip.analysis.stats.rivals import rivals

GAMMA, N_CASCADES = 0.7, 1100  # as observed: 200 blocks, t = 600 to 1000, by events


def dependent_sizes(rng, n_matrices, serial=0.0, spread=0.0, gamma=GAMMA, n_cascades=N_CASCADES):
    """Sizes exactly exponential when pooled, dependent within a matrix: shape (G, n_cascades).

    Normal scores, AR(1) with coefficient `serial` plus one shift a matrix of standard deviation `spread`, are mapped
    to sizes by the exponential's quantiles: every single size follows the law. A spread of 0.048 gives gammas a
    standard deviation of 0.03 between matrices, where sampling alone gives 0.021; observed is 0.014.
    """
    noise = rng.standard_normal((n_matrices, n_cascades))
    noise[:, 1:] *= np.sqrt(1 - serial**2)
    scores = signal.lfilter([1.0], [1.0, -serial], noise, axis=1)
    scores = np.sqrt(1 - spread**2) * scores + spread * rng.standard_normal((n_matrices, 1))
    return np.maximum(np.ceil(-stats.norm.logsf(scores) / gamma), 1).astype(int)


def of_rates(rng, rates):
    """Sizes from the exponential of each of `rates`."""
    return rng.geometric(1 - np.exp(-rates))


def counted(sizes, k_max=200, k_min=1):
    """Sizes k_min..k_max and numbers by matrix, as the estimators take them."""
    histograms = np.array([np.bincount(row, minlength=k_max + 1) for row in sizes])
    return truncate(histograms, k_min, k_max)


#: Ensembles for which the law holds: (rng, n_matrices) -> sizes by matrix.
TRUE = {
    "independent": lambda rng, g: dependent_sizes(rng, g),
    "serial as observed": lambda rng, g: dependent_sizes(rng, g, serial=-0.03),
    "serial 0.3": lambda rng, g: dependent_sizes(rng, g, serial=0.3),
    "spread 0.03": lambda rng, g: dependent_sizes(rng, g, serial=-0.03, spread=0.048),
    "gammas spread by 0.03": lambda rng, g: of_rates(rng, np.repeat(rng.normal(GAMMA, 0.03, (g, 1)), N_CASCADES, 1)),
}
#: Ensembles for which it does not.
FALSE = {
    "mixture of 0.55 and 0.95": lambda rng, g: of_rates(rng, rng.choice([0.55, 0.95], (g, N_CASCADES))),
    "mixture of 0.6 and 0.85": lambda rng, g: of_rates(rng, rng.choice([0.6, 0.85], (g, N_CASCADES))),
    "power law 2.06": lambda rng, g: np.minimum(rng.zipf(2.06, (g, N_CASCADES)), 200),
    "cut-off power law, alpha 0.2": lambda rng, g: draw(rng, g, lambda k: k**-0.2 * np.exp(-0.62 * k)),
    "cut-off power law, alpha 0.1": lambda rng, g: draw(rng, g, lambda k: k**-0.1 * np.exp(-0.66 * k)),
}  # fmt: skip


def draw(rng, n_matrices, weights, k_max=200, n_cascades=N_CASCADES):
    """Independent sizes with P(k) in proportion to weights(k)."""
    shares = weights(np.arange(1.0, k_max + 1))
    edges = np.cumsum(shares / shares.sum())
    return 1 + np.minimum(np.searchsorted(edges, rng.random((n_matrices, n_cascades))), k_max - 1)


def rejections(make, n_matrices, ensembles, seed=0, level=0.05):
    """Shares of ensembles with p_value up to `level`, and with the verdict "rejected" (wherever the tail is cut)."""
    hits = np.zeros(2)
    for one in range(ensembles):
        rng = np.random.default_rng([seed, one])
        found = goodness(*counted(make(rng, n_matrices)), 1 - level, rng)
        hits += [found.p_value is not None and found.p_value <= level, found.verdict(level) == "rejected"]
    return hits / ensembles


def rival_rejections(make, n_matrices, ensembles, seed=0, level=0.05, families=RIVALS):
    """For each family, share of ensembles with a p-value up to `level`; and, last, of any verdict "better"."""
    hits = np.zeros(len(families) + 1)
    for one in range(ensembles):
        rng = np.random.default_rng([seed, one])
        found = rivals(*counted(make(rng, n_matrices)), 1 - level, families)
        hits[:-1] += [other.p_value is not None and other.p_value <= level for other in found]
        hits[-1] += any(other.verdict == "better" for other in found)
    return hits / ensembles


def rate_coverage(make, n_matrices, ensembles, k_min=1, k_max=200, seed=0, gamma=GAMMA):
    """Share of ensembles whose 95% interval of the truncated gamma holds the planted one, and how wide it is.

    The width is in units of what the estimate's own scatter over the ensembles asks for.
    """
    every = [
        rate(*counted(make(np.random.default_rng([seed, one]), n_matrices), k_max, k_min), 0.95)
        for one in range(ensembles)
    ]
    half = np.mean([found.high - found.value for found in every])
    scatter = np.std([found.value for found in every], ddof=1)
    held = np.mean([found.low <= gamma <= found.high for found in every])
    return held, half / (stats.t.ppf(0.975, n_matrices - 1) * scatter)


def share_study(n_matrices, spread, ensembles, seed=0, serial=-0.03, n_parts=10):
    """Coverage of the interval of the share between matrices, mean estimate, mean lower and upper end."""
    rows = []
    for one in range(ensembles):
        rng = np.random.default_rng([seed, one])
        sizes = dependent_sizes(rng, n_matrices, serial, spread)
        parts = [np.array([[p.sum(), p.size] for p in np.array_split(row, n_parts)]) for row in sizes]
        found = between_share(parts, 0.95)
        rows.append((found.value, found.low, found.high))
    return np.array(rows)


def halfway(family, k_max=200):
    """Sizes from a mixture of the exponential and a rival to which both, refitted, are equally close."""
    sizes = np.arange(1.0, k_max + 1)
    planted = {"power law": (2.06,), "lognormal": (0.2, 0.9)}[family.name]
    ends = [np.exp(log_shares(*law)) for law in ((EXPONENTIAL, sizes, (GAMMA,)), (family, sizes, planted))]

    def gain(weight):
        shares = (1 - weight) * ends[0] + weight * ends[1]
        return maximise(family, sizes, shares).log_likelihood - maximise(EXPONENTIAL, sizes, shares).log_likelihood

    weight = optimize.brentq(gain, 0.0, 1.0, xtol=1e-4)
    shares = (1 - weight) * ends[0] + weight * ends[1]
    return lambda rng, g: draw(rng, g, lambda k: shares)


def main():
    for n_matrices, ensembles in ((6, 2000), (10, 2000), (20, 2000), (100, 1000)):
        for name, make in TRUE.items():
            found = np.round(rejections(make, n_matrices, ensembles), 3)
            print(f"goodness, false alarms, {n_matrices} matrices, {name}: {found}", flush=True)
    for n_matrices in (6, 20):
        for name, make in FALSE.items():
            found = np.round(rejections(make, n_matrices, 200), 2)
            print(f"goodness, power, {n_matrices} matrices, {name}: {found}", flush=True)
    nested = [family for family in RIVALS if family.null is not None]
    for n_matrices, ensembles, kinds in (
        (5, 500, ["spread 0.03"]),
        (10, 500, ["spread 0.03"]),
        (20, 1000, list(TRUE)),
    ):
        for name in kinds:
            found = rival_rejections(TRUE[name], n_matrices, ensembles, families=nested)
            print(f"nested rivals, false alarms, {n_matrices} matrices, {name}: {np.round(found, 3)}", flush=True)
    for family in (POWER_LAW, LOGNORMAL):
        make = halfway(family)
        for n_matrices in (5, 20):
            found = rival_rejections(make, n_matrices, 1000, families=[family])
            print(f"Vuong, false alarms halfway, {n_matrices} matrices, {family.name}: {found[0]:.3f}", flush=True)
    for name, make in FALSE.items():
        print(f"rivals, power, 20 matrices, {name}: {np.round(rival_rejections(make, 20, 100), 2)}")
    for n_matrices, spread in ((20, 0.0), (20, 0.048), (20, 0.2), (100, 0.048)):
        value, low, high = share_study(n_matrices, spread, 500).T
        print(f"share between, {n_matrices} matrices, spread {spread}: mean {value.mean():.3f}, {low.mean():.3f} to "
              f"{high.mean():.3f}, low > 0 in {np.mean(low > 0):.3f}")  # fmt: skip
    for n_matrices in (5, 20, 100):
        for k_min in (1, 3):
            for name, make in TRUE.items():
                found = np.round(rate_coverage(make, n_matrices, 1000, k_min), 3)
                print(f"coverage of gamma, {n_matrices} matrices, k_min = {k_min}, {name}: {found}", flush=True)


if __name__ == "__main__":
    main()
