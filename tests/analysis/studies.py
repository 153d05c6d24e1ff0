"""Planted studies: bias of the estimators of `stickslip.analysis.stats`, and coverage of their 95% intervals.

python -m tests.analysis.studies                      # all of them, some minutes; a new seed each time
python -m tests.analysis.studies gamma growth    # some
python -m tests.analysis.studies --seed 1 --ensembles 500
"""

import argparse
import secrets
from contextlib import suppress
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy import fft, linalg, signal, special, stats

from stickslip.analysis.models import clustering, common_motion, fates, growth, magnitudes, pool, times
from stickslip.analysis.series.cascades import Window
from stickslip.analysis.series.nulls import BlockSteps
from stickslip.analysis.stats import compare, components, shares
from stickslip.analysis.stats.effects import over_null
from stickslip.analysis.stats.estimates import LN2, Estimate, Undefined, gamma, over_matrices, ratio
from stickslip.workflows.scenes import counting
from tests.chance import ERRORS, agrees

CONFIDENCE = 0.95
MATRICES = 20


@dataclass(frozen=True)
class Row:
    """One planted answer: mean error of the estimate, its scatter, and the share of intervals that hold it."""

    study: str
    planted: str
    answer: float
    bias: float
    scatter: float
    coverage: float
    ensembles: int

    def is_covered(self, low=0.93, high=0.97):
        """Whether the share lies within bounds, but for chance."""
        return agrees(round(self.coverage * self.ensembles), self.ensembles, low, high)

    def is_unbiased(self, share=0.1):
        """Whether the bias is less than a share of the scatter, but for chance."""
        return abs(self.bias) <= (share + ERRORS / np.sqrt(self.ensembles)) * self.scatter


def judged(study, planted, answer, estimates: list[Estimate], log=False):
    values = np.array([one.value for one in estimates])
    held = [one.low <= answer <= one.high for one in estimates]
    errors = np.log(values / answer) if log else values - answer
    return Row(study, planted, answer, errors.mean(), errors.std(ddof=1), float(np.mean(held)), len(held))


# ----------------------------------------------------------------------------------- planted laws of the sizes

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


def spread_rates(rng, n_matrices, spread):
    """Rates of matrices that differ by some `spread`; the mean of their mean sizes is that of the rate GAMMA."""
    mean = -1 / np.expm1(-GAMMA)
    means = mean + spread * mean * (mean - 1) * rng.standard_normal((n_matrices, 1))  # d mean / d rate
    return np.repeat(-np.log1p(-1 / means), N_CASCADES, axis=1)


def counted(sizes, k_max=200, k_min=1):
    """Sizes k_min..k_max and numbers by matrix, as the estimators take them."""
    histograms = np.array([np.bincount(row, minlength=k_max + 1)[k_min:] for row in sizes])
    return np.arange(k_min, k_max + 1, dtype=float), histograms.astype(float)


#: Ensembles for which the law holds: (rng, n_matrices) -> sizes by matrix.
TRUE = {
    "independent": lambda rng, g: dependent_sizes(rng, g),
    "serial as observed": lambda rng, g: dependent_sizes(rng, g, serial=-0.03),
    "serial 0.3": lambda rng, g: dependent_sizes(rng, g, serial=0.3),
    "spread 0.03": lambda rng, g: dependent_sizes(rng, g, serial=-0.03, spread=0.048),
    "gammas spread by 0.03": lambda rng, g: of_rates(rng, spread_rates(rng, g, 0.03)),
}


# ----------------------------------------------------------------------------------------------- cascades


def of_law(rng, shares, shape):
    """Independent sizes 1, 2, ... with the probabilities `shares`."""
    edges = np.cumsum(shares)
    return 1 + np.minimum(np.searchsorted(edges, rng.random(shape) * edges[-1]), len(shares) - 1)


def excess_of(shares):
    k = np.arange(1, len(shares) + 1)
    m = shares @ k / shares.sum()
    return (shares @ k**2 / shares.sum() - m**2) / (m * (m - 1)) - 1


def geometric(rate, k_max=400):
    return (1 - np.exp(-rate)) * np.exp(-rate * np.arange(k_max))


def gamma_study(rng, ensembles):
    """Rate of the exponential; sizes that depend on each other within a matrix, and rates that differ."""
    for name, make in TRUE.items():
        for g in (4, MATRICES):
            found = []
            for _ in range(ensembles):
                k = make(rng, g)
                sums = np.column_stack([k.sum(axis=1), np.full(g, k.shape[1])])
                found.append(over_matrices(gamma, sums, CONFIDENCE))
            yield judged("gamma", f"{name}; {g} matrices", GAMMA, found)


def two_state_blocks(rng, n, p, pull, changes, runs):
    """Runs of n two-state blocks from equilibrium of the independent ones, each (Window, BlockSteps).

    A block that sticks lets go at the rate (1 - p) f, one that slips sticks at p / f, f = exp(pull x), where x more
    than n p stick: 1 without coupling, else all blocks feel how many stick.
    """
    sticks = rng.random((runs, n)) < p
    level, each = sticks.sum(axis=1), np.arange(runs)
    k = level.copy()
    step, block = np.empty((changes, runs), dtype=np.int64), np.empty((changes, runs), dtype=np.int64)
    gap = np.empty((changes, runs))
    for row in range(changes):
        f = np.exp(pull * (k - n * p))
        out, into = (1 - p) * k * f, p * (n - k) / f
        gap[row] = rng.exponential(1.0, runs) / (out + into)
        is_exit = rng.random(runs) * (out + into) < out
        block[row] = np.argmax(rng.random((runs, n)) * (sticks == is_exit[:, None]), axis=1)
        sticks[each, block[row]] = ~is_exit
        step[row] = np.where(is_exit, -1, 1)
        k = k + step[row]
    t = np.cumsum(gap, axis=0)
    for i in range(runs):
        times, t_stop = t[:, i].copy(), float(t[-1, i])
        yield (
            Window(0.0, t_stop, int(level[i]), times, step[:, i].copy()),
            BlockSteps(0.0, t_stop, times, block[:, i].copy(), step[:, i].copy()),
        )


def counting_study(rng, ensembles):
    """Parts of gamma's excess: of independent blocks all but counting are 0; of others all runs are the answer."""
    n, p, changes = 40, 0.3, 3000
    of = counting.parts(n)
    for name, pull in (("independent", 0.0), ("held back", 0.03), ("driven", -0.01)):
        planted = two_state_blocks(rng, n, p, pull, changes, 2 * POOL * ensembles)
        rows = np.array([counting.run_sums(*run, 10, rng) for run in planted])
        picks = rng.integers(len(rows), size=(ensembles, MATRICES))
        whole = rows.sum(axis=0, keepdims=True)
        independent = {
            "excess": pool.gamma(n, n * p) / LN2 - 1, "finite_size": pool.gamma(n, n * p) / LN2 - 1,
            "own_dynamics": 0.0, "coupling": 0.0, "rise": pool.slope(n, n * p), "rise_over_two_state": 0.0,
        }  # fmt: skip
        for part, answer in independent.items():
            found = [over_matrices(of[part], rows[some], CONFIDENCE) for some in picks]
            yield judged(f"counting: {part}", name, float(of[part](whole)[0]) if pull else answer, found)


# ---------------------------------------------------------------------------------------------- slow mode

#: Runs in the pool that ensembles are picked from, over ensembles: their luck, which all ensembles share, is then a
#: ninth of an ensemble's error. And blocks of a run: few, so that there can be many runs.
POOL, BLOCKS = 3, 16
SPAN = 600.0
TAUS = (0.05, 0.2, 1.0)


def first(sums):
    return sums[:, 0]


def blocks_run(rng, n=40, depth=0.0, period=200.0, shape=3):
    """Blocks that stick and slip by turns, sojourns of gamma-distributed length, each with its own rates.

    With `depth` a common mode of wandering phase makes stays longer and shorter where they slip: all move together.
    """
    fine = np.linspace(-300.0, 2 * SPAN, 4001)
    phase = 2 * np.pi * fine / period + rng.uniform(0, 2 * np.pi)
    phase += np.cumsum(rng.standard_normal(len(fine))) * np.sqrt(np.diff(fine)[0] / period)
    t, of_block, step = [], [], []
    for block in range(n):
        means = np.array([1.0, 5.0]) * np.exp(0.5 * rng.standard_normal())  # where it sticks, and where it slips
        at = -rng.uniform(100.0, 100.0 + 10 * means.sum())  # no two blocks in step
        stays = (rng.gamma(shape, 1 / shape, (int(4 * SPAN / means.sum()) + 60, 2)) * means).ravel()
        if depth:
            times = np.full(len(stays), np.inf)
            for k, stay in enumerate(stays):
                at += stay * np.exp(depth * np.sin(np.interp(at, fine, phase))) if k % 2 else stay
                times[k] = at
                if at > SPAN:
                    break
        else:
            times = at + np.cumsum(stays)
        inside = (times > 0) & (times <= SPAN)
        t.append(times[inside])
        step.append(np.where(np.arange(len(times)) % 2, 1, -1)[inside])
        of_block.append(np.full(inside.sum(), block))
    t, of_block, step = (np.concatenate(x) for x in (t, of_block, step))
    order = np.argsort(t)
    return BlockSteps(0.0, SPAN, t[order], of_block[order], step[order])


def over_rotation(study, names, runs, rng, ensembles, answers):
    """Each part over rotation, of ensembles picked from runs, shape (m, p, 2)."""
    picks = rng.integers(len(runs), size=(ensembles, MATRICES))
    for k, (name, answer) in enumerate(zip(names, answers, strict=True)):
        rows = runs[:, k]
        found = [over_null(first, rows[some, :1], rows[some, 1:], CONFIDENCE).ratio for some in picks]
        yield judged(study, name, answer, found, log=True)


def triggered(steps, share, delay, rng):
    """Blocks of which a share of the exits moves to an exponential delay after others; each stays with its block."""
    t, exits = steps.t.copy(), rng.permutation(np.flatnonzero(steps.step < 0))
    moved, stay = np.split(exits, [round(share * len(exits))])
    t[moved] = (t[rng.choice(stay, len(moved))] + rng.exponential(delay, len(moved))) % steps.span
    order = np.argsort(t)
    return BlockSteps(0.0, steps.span, t[order], steps.block[order], steps.step[order])


def triggering_study(rng, ensembles):
    """Pairs of exits within tau over rotation: 1 for independent blocks, else that of all runs.

    A share of the exits follows another after a tenth of the mean gap.
    """
    for share in (0.0, 0.02, 0.1):
        rows = []
        for _ in range(ensembles if share else POOL * ensembles):
            steps = blocks_run(rng, BLOCKS)
            if share:
                steps = triggered(steps, share, 0.1 * SPAN / np.sum(steps.step < 0), rng)
            rows.append(clustering.measure(steps, TAUS))
        runs = np.array(rows)
        sums = runs.sum(axis=0)
        answers = sums[:, 0] / sums[:, 1] if share else np.ones(len(TAUS))
        names = [f"{share:g} follow, tau = {tau:g}" for tau in TAUS]
        yield from over_rotation("triggering: pairs", names, runs, rng, ensembles, answers)


# ------------------------------------------------------------------------------------------------ slow common motion

STEP = 10.0  # of samples
OWN, LEFT = 220.0, 0.45  # the power of independent blocks, and the share of it that is left: as observed at n = 200


def oscillators(rng, runs, span, period, quality):
    """Damped oscillators of variance 1 that noise drives, from their steady state: shape (runs, span / STEP).

    x'' + 2 g x' + w0^2 x = noise, by the exact law of (x, x') from one sample to the next; `period` is 2 pi / w0, one
    number or one a run.
    """
    w0 = np.broadcast_to(2 * np.pi / np.asarray(period, dtype=float), runs)
    drift = np.zeros((runs, 2, 2))
    drift[:, 0, 1], drift[:, 1, 0], drift[:, 1, 1] = 1.0, -(w0**2), -w0 / quality
    forward = linalg.expm(drift * STEP)
    steady = np.zeros((runs, 2, 2))
    steady[:, 0, 0], steady[:, 1, 1] = 1.0, w0**2
    kick = np.linalg.cholesky(steady - forward @ steady @ forward.transpose(0, 2, 1))
    state = np.sqrt(np.array([np.ones(runs), w0**2]).T) * rng.standard_normal((runs, 2))
    found = np.empty((runs, round(span / STEP)))
    for k in range(found.shape[1]):
        found[:, k] = state[:, 0]
        state = np.einsum("rij,rj->ri", forward, state) + np.einsum(
            "rij,rj->ri", kick, rng.standard_normal((runs, 2))
        )
    return found


def rhythmic(rng, ensembles, span, period, quality, variance=11.0, spread=0.0, shortest=108.0):
    """Spectra of ensembles of runs that swing beside white noise; periods differ between matrices by `spread`."""
    runs = ensembles * MATRICES
    periods = period * np.exp(spread * rng.standard_normal(runs))
    x = np.sqrt(variance) * oscillators(rng, runs, span, periods, quality)
    x += np.sqrt(LEFT * OWN / (2 * STEP)) * rng.standard_normal(x.shape)
    m = common_motion.n_harmonics(span, shortest)
    power = 2 * abs(fft.rfft(x, axis=1)[:, 1 : m + 1] * STEP) ** 2 / span
    rows = zip(power.reshape(-1, MATRICES, m), x.var(axis=1).reshape(-1, MATRICES), strict=True)
    return [common_motion.Spectra(span, one, np.full_like(one, OWN), var, np.ones(MATRICES)) for one, var in rows]


def rhythm_study(rng, ensembles):
    """Period, quality and share of a planted oscillator; and without one, the share that is told so, 95%.

    Windows hold 3 to 18 periods. Where periods differ between matrices, the answer is the fit to their mean spectrum.
    """
    ensembles = max(ensembles // 4, 40)
    for span, period, quality, spread in (
        (1400.0, 470.0, 1.2, 0.0), (2400.0, 470.0, 1.2, 0.0), (2400.0, 470.0, 1.2, 0.15), (5400.0, 470.0, 1.2, 0.15),
        (5400.0, 300.0, 3.0, 0.0),
    ):  # fmt: skip
        m, noise = common_motion.n_harmonics(span, 108.0), LEFT * OWN / (2 * STEP)
        periods = period * np.exp(spread * np.linspace(-3, 3, 61)[:, None])
        weights = np.exp(-0.5 * np.linspace(-3, 3, 61) ** 2)
        frequency = np.arange(1, m + 1) / span
        mean = 11.0 * np.average(common_motion.expected(frequency, span, periods, quality), axis=0, weights=weights)
        power, at, q, _ = np.exp(common_motion.best(span, mean + LEFT * OWN, np.full(m, OWN)))
        answers = {"period": at, "quality": q, "share": power / (11.0 + noise)}
        every = [
            common_motion.common_motion(one, CONFIDENCE, rng).estimates
            for one in rhythmic(rng, ensembles, span, period, quality, spread=spread)
        ]
        for name, answer in answers.items():
            what = f"{name}: {period:g}, quality {quality:g}, spread {spread:g}, windows of {span:g}"
            yield judged("rhythm", what, answer, [one[name] for one in every if name in one], log=True)
    for span in (1400.0, 5400.0):
        p = [common_motion.p_value(one, rng) for one in rhythmic(rng, ensembles, span, 470.0, 1.2, variance=0.0)]
        yield Row(
            "rhythm: p > 0.05",
            f"none, windows of {span:g}",
            np.nan,
            np.nan,
            np.nan,
            np.mean(np.array(p) > 0.05),
            ensembles,
        )


# ------------------------------------------------------------------------------------------- growth rates


def separating(rng, rate, g=MATRICES, spread=0.002, noise=0.3, walk=0.02, start=1e-6, t_end=1000.0):
    """Distances exp(rate t): a rate of each matrix, noise correlated over 20 units, and a random walk."""
    times = np.arange(0, t_end + 1, 5.0)
    rates = rate + spread * rng.standard_normal(g)
    hold = np.exp(-5.0 / 20)
    fresh = rng.standard_normal((g, len(times))) * noise * np.sqrt(1 - hold**2)
    wander = signal.lfilter([1.0], [1.0, -hold], fresh, axis=1)
    wander += np.cumsum(rng.standard_normal((g, len(times))), axis=1) * walk * np.sqrt(5.0)
    log = np.log(start) + rates[:, None] * times + wander
    distance = np.sqrt(np.exp(2 * log) + 1e-24 * rng.chisquare(1, log.shape))  # error of integration
    return times, np.minimum(distance, 0.3 * np.exp(0.2 * rng.standard_normal(log.shape)))  # saturation


def growth_study(rng, ensembles):
    """Mean growth rate with its sign; displacements of 1e-6, errors of 1e-12, saturation at 0.3."""
    for rate in (0.012, 0.0036, 0.0, -0.0036, -0.0128):
        found = []
        for _ in range(ensembles):
            times, distances = separating(rng, rate)
            one = growth.growth(times, distances, range(MATRICES), 100.0, 200.0, (1e-11, 3e-2), CONFIDENCE)
            found.append(one.rate)
        yield judged("growth rate", f"{rate:g}", rate, found)


# --------------------------------------------------------------------------------------- variance components


def matrices(rng, correlation, theta, g=MATRICES, k=2, shift=0.5, heavy=False):
    """Base and replicates (g, k), one changed run (g, 1); the mean square of the change is theta 2 var b."""
    draw = (
        (lambda *shape: rng.standard_t(5, shape) / np.sqrt(5 / 3)) if heavy else (lambda *s: rng.standard_normal(s))
    )
    b, e = np.sqrt(correlation), np.sqrt(1 - correlation)
    own = b * draw(g, 1)
    size = np.sqrt(2 * theta) * b
    change = size * (np.sqrt(shift) + np.sqrt(1 - shift) * draw(g, 1))
    return own + e * draw(g, k), own + change + e * draw(g, 1)


def components_study(rng, ensembles):
    """The change against a redraw; part of the change is common."""
    for correlation, theta, heavy in (
        (0.8, 0.0, False), (0.8, 0.2, False), (0.8, 1.0, False),
        (0.5, 0.2, False), (0.1, 0.2, False), (0.8, 0.2, True),
    ):  # fmt: skip
        every = [components.against_redraw(*matrices(rng, correlation, theta, heavy=heavy), CONFIDENCE)
                 for _ in range(ensembles)]  # fmt: skip
        bounded = np.array([one.theta.high is not None for one in every])
        held = [
            not known or one.theta.low <= theta <= one.theta.high for one, known in zip(every, bounded, strict=True)
        ]
        errors = np.array([one.theta.value - theta for one, known in zip(every, bounded, strict=True) if known])
        name = f"{theta:g}, correlation {correlation:g}{', heavy tails' * heavy}; bounded in {bounded.mean():.2f}"
        yield Row("change over redraw", name, theta, np.median(errors), errors.std(), np.mean(held), ensembles)


# ------------------------------------------------------------------------------------------ two means, shares


def agreeing(rng, share, correlation, n_trials, shape):
    """Shares of trials, alike within a system: beta-binomial, with an intraclass correlation."""
    if not correlation:
        return rng.binomial(n_trials, share, shape) / n_trials
    weight = 1 / correlation - 1
    return rng.binomial(n_trials, rng.beta(share * weight, (1 - share) * weight, shape)) / n_trials


def blocks_study(rng, ensembles):
    """Share of the blocks of a run, alike within a system, of 20 blocks; and Student's interval beside it.

    It covers 91% to 99%: too much where a share is so small that most ensembles have none of it. Of 100 blocks that
    agree as closely as in the last rows it covers 87%: the few systems that have nearly all are often not among those
    drawn, and nothing shows it.
    """
    for g, share, correlation in product((5, 12, 20, 40), (0.02, 0.05, 0.1, 0.2, 0.5), (0.0, 0.1, 0.3, 0.5)):
        found, student = [], []
        for row in agreeing(rng, share, correlation, 20, (ensembles, g)):
            sums = np.column_stack([row, np.ones(g)])
            found.append(shares.mean_within(sums, 1.0, CONFIDENCE))
            student.append(over_matrices(ratio, sums, CONFIDENCE))
        planted = f"{share:g}, {g} systems, correlation {correlation:g}"
        narrow = judged("", planted, share, student)
        yield judged("share of blocks", f"{planted}; Student {narrow.coverage:.3f}", share, found)


#: Systems, runs of each, and how often a run has it in the time watched.
RARE = tuple(product(((12, 1), (50, 1), (12, 5), (200, 1)), (0.02, 0.1, 0.5)))


def rare_study(rng, ensembles):
    """Restricted means of what few runs have in the time watched, and how far others are that have it twice as often.

    All are watched to 1, or each to an end from 0.4 to 2; the runs of a system are alike, and the two are paired.
    """
    for ((g, k), rate), is_cut in product(RARE, (False, True)):
        found: dict[str, list[Estimate]] = {"mean": [], "difference": [], "relative": []}
        rates, units = np.array([rate, 2 * rate]), np.repeat(np.arange(g), k)
        means = -np.expm1(-rates) / rates
        answers = {"mean": means[0], "difference": means[1] - means[0], "relative": means[1] / means[0] - 1}
        n_ended = 0
        for _ in range(ensembles):
            rows = []
            for own, u in zip(rates, latent(rng, g, k, 0.3, 2), strict=True):
                t, end = -np.log(u.ravel()) / own, rng.uniform(0.4, 2.0, g * k) if is_cut else np.ones(g * k)
                some = times.Times.of_runs(units, np.minimum(t, end), t <= end)
                n_ended += 0 if rows else len(np.unique(some.of_unit[some.ended]))
                if some.reaches(1.0):
                    rows.append(some.restricted(1.0).rows)
            if len(rows) < 2:
                continue
            found["mean"].append(shares.mean_within(rows[0], 1.0, CONFIDENCE))
            for name, test in (
                ("difference", compare.bounded_difference(*rows, True)),
                ("relative", compare.bounded_ratio(*rows, True, 1.0)),
            ):
                found[name].append(Estimate(test.difference, *test.interval(CONFIDENCE)))
        of = (
            f"{g} systems of {k}, rate {rate:g}, {'cut off' if is_cut else 'to 1'}; {n_ended / ensembles:.1f} have it"
        )
        for name, answer in answers.items():
            yield judged(f"rare: {name}", of, answer, found[name])


def latent(rng, n_systems, n_runs, correlation, n_settings):
    """Uniform numbers, shape (settings, systems, runs), alike within a system by a normal score of its own."""
    own = rng.standard_normal((n_systems, 1))
    each = rng.standard_normal((n_settings, n_systems, n_runs))
    return special.ndtr(np.sqrt(correlation) * own + np.sqrt(1 - correlation) * each)


#: Systems, runs of each, and how alike their scores are.
ENSEMBLES = ((20, 1, 0.5), (60, 1, 0.5), (20, 5, 0.3))
#: The same of few systems, of which no interval can cover each share in 93 to 97%: of five runs of which one in ten
#: has it, none or one has it in 91.9%, and up to two in 99.1%.
FEW = ((4, 1, 0.5), (5, 1, 0.5), (5, 4, 0.3), (5, 10, 0.0), (8, 4, 0.3))


def truth_study(rng, ensembles):
    """Shares of runs with a property, from 0.1 to 0.9 anew each time, and differences between two settings of these.

    Of one share coverage goes up and down with it, as runs are whole; hence many. Of four to eight systems it is 94%
    to 99%.
    """

    def off(rows, share):
        estimate, *ends, _ = shares.share_over_matrices(rows, CONFIDENCE)
        return estimate - share, *(np.array(ends) - share)

    for g, k, correlation in ENSEMBLES:
        found = {"share": [], "difference, paired": [], "difference, independent": []}
        for p, q in rng.uniform(0.1, 0.9, (ensembles, 2)):
            first, second = latent(rng, g, k, correlation, 2)
            (other,) = latent(rng, g, k, correlation, 1)
            a, b, c = (
                np.column_stack([(some < share).sum(axis=1), np.full(g, k)]).astype(float)
                for some, share in ((first, p), (second, q), (other, q))
            )
            found["share"].append(off(a, p))
            for name, paired, rows in (("paired", True, b), ("independent", False, c)):
                test = compare.bounded_difference(a, rows, paired, is_counted=True)
                shown = (test.difference, *test.interval(CONFIDENCE))
                found[f"difference, {name}"].append(tuple(end - (q - p) for end in shown))
        for name, errors in found.items():
            yield judged(f"truths: {name}", f"{g} systems, {k} runs", 0.0, [Estimate(*one) for one in errors])
    for g, k, correlation in FEW:
        found_of_few = []
        for p in rng.uniform(0.1, 0.9, ensembles):
            (some,) = latent(rng, g, k, correlation, 1)
            found_of_few.append(Estimate(*off(np.column_stack([(some < p).sum(axis=1), np.full(g, k)]), p)))
        yield judged("truths of few: share", f"{g} systems, {k} runs", 0.0, found_of_few)


def times_study(rng, ensembles):
    """Times that the end of a run may cut off: Weibull's law at two settings; all seen, to 20, or each to 8 to 40.

    The exponent is 1.5, the scales 10 and 14: medians 7.83 and 10.97. Restricted means are up to 16.
    """
    ends = {"all seen": (np.inf, np.inf), "to 20": (20.0, 20.0), "to 8 to 40": (8.0, 40.0)}
    scales, limit = np.array([10.0, 14.0]), 16.0
    medians = scales * np.log(2) ** (1 / 1.5)
    area = special.gamma(1 / 1.5) * special.gammainc(1 / 1.5, (limit / scales) ** 1.5) * scales / 1.5
    for (g, k, correlation), watched in product((*ENSEMBLES, (200, 1, 0.5)), ends):
        names = ("median", "median: difference", "restricted mean", "restricted mean: difference")
        found = {name: list[Estimate]() for name in names}
        units = np.repeat(np.arange(g), k)
        for _ in range(ensembles):
            drawn = [
                scale * (-np.log(u.ravel())) ** (1 / 1.5)
                for scale, u in zip(scales, latent(rng, g, k, correlation, 2), strict=True)
            ]
            least, most = ends[watched]
            cut = [np.full(g * k, least) if least == most else rng.uniform(least, most, g * k) for _ in drawn]
            both = [
                times.Times.of_runs(units, np.minimum(t, end), t <= end) for t, end in zip(drawn, cut, strict=True)
            ]
            one = both[0].median(CONFIDENCE)
            found["median"].append(Estimate(one.value or limit, one.low or 0.0, one.high or np.inf))
            tests = {}
            if all(part.reaches(limit) for part in both):
                areas = [part.restricted(limit).rows for part in both]
                found["restricted mean"].append(shares.mean_within(areas[0], limit, CONFIDENCE))
                tests["restricted mean: difference"] = compare.bounded_difference(*areas, True, limit)
            with suppress(Undefined):  # where fewer than half have it, or the interval has no end
                tests["median: difference"] = times.median_difference(*both, True)
            for name, one in tests.items():
                found[name].append(Estimate(one.difference, *one.interval(CONFIDENCE)))
        answers = (medians[0], medians[1] - medians[0], area[0], area[1] - area[0])
        for name, answer in zip(names, answers, strict=True):
            share = len(found[name]) / ensembles
            if share > 0.9:  # else what is left is a choice among ensembles
                planted = f"{answer:.3g}, {g} systems, {k} runs, {watched}"
                given = "" if share == 1 else f", given in {share:.2f}"
                yield judged(f"times: {name}", planted + given, answer, found[name])


def renewals(rng, n_runs, n_blocks, mean, span):
    """Times of exits of blocks in a window, ascending, by run.

    Exits of a block are a renewal process from long before the window on, with gamma-distributed times between them
    of a coefficient of variation of 0.7.
    """
    shape, before = 1 / 0.7**2, 10 * mean
    gaps = rng.gamma(shape, mean / shape, (n_runs, n_blocks, int(3 * (before + span) / mean) + 20))
    exits = np.cumsum(gaps, axis=2) - before
    return [np.sort(run[(run >= 0.0) & (run < span)]) for run in exits.reshape(n_runs, -1)]


# --------------------------------------------------------------------------------------------------- survival


def survival(rng, n_runs, rate, t_end, delay):
    """Kaplan and Meier of runs that end at a constant rate and are watched for t_end, as the question `fates` has it.

    Certificates come some exponential delay after the end, none after t_end: what ended without one is quiet, or
    seems in motion. Three in ten of the runs that go on are in a lull at t_end.
    """
    ended = rng.exponential(1 / rate, n_runs)
    certified, goes_on = ended + rng.exponential(delay, n_runs), ended > t_end
    where = np.where(rng.random(n_runs) < 0.3, rng.uniform(0.0, 0.75, n_runs), rng.uniform(0.75, 1.0, n_runs))
    last = np.where(goes_on, where * t_end, ended)
    hows = [
        fates.fate("collapsed" if t_stop <= t_end else "finished", (np.array([t]), np.array([0])), t_end, growth_rate)
        for t, t_stop, growth_rate in zip(last, certified, np.where(goes_on, 1e-4, -1e-4), strict=True)
    ]
    t_stop = np.minimum(certified, t_end)
    return fates.survival(np.array(hows), last, t_stop, np.full(n_runs, t_end), CONFIDENCE).curve


def survival_study(rng, ensembles, delay=20.0):
    """Share of runs that have not ended, at times before the last quarter, of 20 and 60 runs."""
    for n_runs, rate in product((MATRICES, 60), (3e-4, 1e-3)):
        curves = [survival(rng, n_runs, rate, 2000.0, delay) for _ in range(ensembles)]
        for at in (500.0, 1000.0, 1400.0):
            found = []
            for t, *of_fates in curves:
                k = np.searchsorted(t, at, side="right") - 1
                found.append(Estimate(*(float(share[k]) for share in of_fates)))
            yield judged("survival", f"rate {rate:g}, t = {at:g}, {n_runs} runs", float(np.exp(-rate * at)), found)


# ------------------------------------------------------------------------------------------ methods by whole laws


def autoregressive(rng, n, rho):
    """A Gaussian AR(1) series of variance one, shape (n,)."""
    noise = rng.standard_normal(n) * np.sqrt(1 - rho**2)
    noise[0] = rng.standard_normal()
    return signal.lfilter([1.0], [1.0, -rho], noise)


def shifted(rng, shift, rho, n_systems=MATRICES, n_values=400, spread=0.3, of_shift=0.0):
    """Of each system values by two methods, one series each, the second shifted; systems differ, in numbers too."""
    pairs = []
    for _ in range(n_systems):
        own, moved = spread * rng.standard_normal(), shift + of_shift * rng.standard_normal()
        counts = rng.poisson(n_values * np.exp(0.15 * rng.standard_normal()), 2) + 1
        first, second = (own + autoregressive(rng, n, rho) for n in counts)
        pairs.append((first, second + moved))
    return pairs


def gap_of(shift, spread=0.3, of_shift=0.0):
    """Largest gap of the distribution functions of `shifted`, which are normal over systems."""
    if not (shift or of_shift):
        return 0.0
    x = np.linspace(-5, 5, 5001)
    second = special.ndtr((x - shift) / np.sqrt(1 + spread**2 + of_shift**2))
    return float(np.abs(second - special.ndtr(x / np.sqrt(1 + spread**2))).max())


#: By name: how ensembles are drawn, and the answer; series remember some three values.
PLANTED_LAWS = {
    f"gap, shift {shift:g}{f' +- {of_shift:g}' if of_shift else ''}, rho {rho:g}": (
        (shift, rho, MATRICES, 400, 0.3, of_shift), gap_of(shift, 0.3, of_shift)
    )
    for shift, of_shift in ((0.0, 0.0), (0.05, 0.0), (0.1, 0.0), (0.2, 0.0), (0.13, 0.1)) for rho in (0.0, 0.7)
}  # fmt: skip


# ------------------------------------------------------------------------------------------------ magnitudes

PICTURES = [magnitudes.Picture.POWER, magnitudes.Picture.CUT_OFF, magnitudes.Picture.PEAK, magnitudes.Picture.NONE]


def planted_catalogue(rng, picture):
    """Magnitudes of 8 to 40 systems, in no order in time, with b and the share of the peak.

    They have 10^3 to 10^5 events beside an atom of up to 80% in half of the catalogues; at least 60 events are in the
    peak, or beyond the cut-off if there were none: with fewer neither can be seen.
    """
    n_systems, b, atom = int(rng.integers(8, 41)), rng.uniform(0.5, 1.5), rng.choice([0.0, rng.uniform(0.2, 0.8)])
    share, scale, gap = 10 ** rng.uniform(-2.3, -1.0), 10 ** rng.uniform(1.7, 2.5), rng.uniform(1.7, 2.5)
    fewest = {magnitudes.Picture.PEAK: 60 / share, magnitudes.Picture.CUT_OFF: 60 * scale**b}.get(picture, 0)
    n_events = max(10 ** rng.uniform(3, 5), fewest)
    systems = []
    for n in rng.multinomial(int(n_events), rng.dirichlet(np.full(n_systems, 8.0))):
        most = 10**gap if picture is magnitudes.Picture.PEAK else np.inf
        moment = (1 - rng.uniform(size=n) * (1 - most**-b)) ** (-1 / b)
        if picture is magnitudes.Picture.CUT_OFF:
            pool = rng.uniform(size=20 * n + 50) ** (-1 / b)
            moment = pool[rng.uniform(size=len(pool)) < np.exp(-pool / scale)][:n]
        elif picture is magnitudes.Picture.PEAK:
            is_large = rng.uniform(size=n) < share
            moment[is_large] = 10 ** (gap + 0.8 + 0.12 * rng.standard_normal(is_large.sum()))
        elif picture is magnitudes.Picture.NONE:
            moment = 1 + rng.exponential(scale, n)
        n_equal = round(n * atom / (1 - atom))
        systems.append(rng.permutation(np.append(np.log10(moment), np.full(n_equal, -0.2))) - 3.3)
    return systems, b, share * (1 - atom)


def magnitudes_study(rng, ensembles):
    """The picture named right, b, b by rises alone and the peak's share of events; of planted catalogues."""
    for picture in PICTURES:
        errors = {"b": [], "b-positive": [], "peak": []}
        n_right = 0
        for _ in range(ensembles):
            systems, b, in_peak = planted_catalogue(rng, picture)
            law = magnitudes.magnitudes_of(systems, CONFIDENCE)
            n_right += law.picture is picture
            if law.picture is not picture:
                continue
            if law.has_b:
                errors["b"].append((law.b, b))
            rises = magnitudes.b_positive(law, [[values] for values in systems], CONFIDENCE)
            if rises.value is not None:
                errors["b-positive"].append((rises, b))
            if law.picture is magnitudes.Picture.PEAK:
                share, _ = magnitudes.shares_between((law.begins, np.inf), systems, CONFIDENCE)
                errors["peak"].append((share, in_peak))
        share = n_right / ensembles
        yield Row("magnitudes: named right", picture, np.nan, np.nan, np.nan, share, ensembles)
        for name, estimates in errors.items():
            if estimates:
                off = np.array([estimate.value - answer for estimate, answer in estimates])
                held = np.mean([estimate.low <= answer <= estimate.high for estimate, answer in estimates])
                yield Row(f"magnitudes: {name}", picture, np.nan, off.mean(), off.std(), float(held), len(off))


STUDIES = {
    "gamma": gamma_study,
    "triggering": triggering_study,
    "rhythm": rhythm_study,
    "growth": growth_study,
    "components": components_study,
    "survival": survival_study,
    "counting": counting_study,
    "truth": truth_study,
    "times": times_study,
    "blocks": blocks_study,
    "rare": rare_study,
    "magnitudes": magnitudes_study,
}


def study(name, seed, ensembles):
    """The rows of one study."""
    return list(STUDIES[name](np.random.default_rng([seed, list(STUDIES).index(name)]), ensembles))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="STUDY", help=", ".join(STUDIES))
    parser.add_argument("--seed", type=int, default=secrets.randbits(32))
    parser.add_argument("--ensembles", type=int, default=2000)
    asked = parser.parse_args()
    if unknown := set(asked.names) - set(STUDIES):
        parser.error(f"STUDY: expected some of {', '.join(STUDIES)}, got {', '.join(sorted(unknown))}")
    print(f"--seed {asked.seed} --ensembles {asked.ensembles}")
    for name in asked.names or STUDIES:
        print(f"\n## {name}: {' '.join((STUDIES[name].__doc__ or '').split())}\n")
        print("| what | planted | answer | bias | scatter | coverage |\n|---|---|---|---|---|---|")
        for row in study(name, asked.seed, asked.ensembles):
            numbers = ["" if np.isnan(x) else f"{x:.4g}" for x in (row.answer, row.bias, row.scatter)]
            print(f"| {row.study} | {row.planted} | {' | '.join(numbers)} | {row.coverage:.3f} |", flush=True)


if __name__ == "__main__":
    main()
