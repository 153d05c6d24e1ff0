"""Rival laws against a base, as a rule the exponential: by how much they are better, and whether that is shown.

A rival that holds the base is judged by its extra parameter, one that does not by Vuong's difference of
log-likelihoods; the standard error of either comes from the matrices, never from single cascades.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from stickslip.analysis.stats import student
from stickslip.analysis.stats.estimates import Estimate, Undefined, jackknife_error, over_matrices, ratio
from stickslip.analysis.stats.families import EXPONENTIAL, RIVALS, Family, Fit, derivatives, maximise
from stickslip.analysis.stats.multiplicity import holm


@dataclass(frozen=True)
class Rival:
    """A rival beside the base on the same sizes.

    Attributes
    ----------
    fit : Fit or None
    gain : float or None
        Mean log-likelihood of a cascade under the rival minus under the base, in nats. A rival that holds the base
        gains something on any data: about 1 / (2 N) on N independent cascades.
    gain_low, gain_high : float or None
        Interval over matrices; null for a rival that holds the base, where it has none that holds at zero.
    extra : Estimate
        Of the extra internal parameter, `Family.null`; 0 is the base.
    p_value : float or None
    p_adjusted : float or None
        For having asked all the rivals together (Holm).
    verdict : str
        "better", "worse", "as good" or "cannot be told".
    reason : str
    """

    family: Family
    fit: Fit | None = None
    gain: float | None = None
    gain_low: float | None = None
    gain_high: float | None = None
    extra: Estimate = field(default_factory=Estimate)
    p_value: float | None = None
    p_adjusted: float | None = None
    verdict: str = "cannot be told"
    reason: str = ""


def rivals(
    sizes: np.ndarray,
    counts: np.ndarray,
    confidence: float,
    families: Sequence[Family] = RIVALS,
    base: Family = EXPONENTIAL,
) -> list[Rival]:
    """Each rival against the base.

    - One that holds the base: a jackknife-t interval over matrices of its extra parameter, each matrix left
      out by one Newton step from the fit; the chi-square of a likelihood ratio would take cascades as independent.
    - One that does not: Vuong's statistic (1989, Econometrica 57, 307) with the differences of log-likelihood summed
      by matrix.

    Parameters
    ----------
    sizes : ndarray, shape (K,)
    counts : ndarray, shape (G, K)
        As `families.truncate` gives them; matrices without a cascade are left out.
    confidence : float
    families : sequence of Family
    base : Family
    """
    seen = counts[counts.sum(axis=1) > 0]
    try:
        null = maximise(base, sizes, seen.sum(axis=0))
    except Undefined as undefined:
        return [Rival(family, reason=str(undefined)) for family in families]
    judged = [_against(null, maximise(family, sizes, seen.sum(axis=0)), seen, confidence) for family in families]
    return _judged(judged, 1 - confidence)


def _against(base: Fit, fit: Fit, counts: np.ndarray, confidence: float) -> Rival:
    n = counts.sum()
    gain = (fit.log_likelihood - base.log_likelihood) / n
    found = Rival(fit.family, fit, float(gain))
    if fit.family.null is None:
        return _vuong(found, base, counts, confidence)
    try:
        extra = parameter(fit, fit.family.null, counts, confidence)
    except Undefined as undefined:
        return replace(found, reason=str(undefined))
    return replace(found, extra=extra, p_value=_p_value(extra, len(counts), confidence))


def _vuong(found: Rival, base: Fit, counts: np.ndarray, confidence: float) -> Rival:
    assert found.fit is not None
    difference = found.fit.log_shares() - base.log_shares()
    sums = np.column_stack([counts @ difference, counts.sum(axis=1)])
    gain = over_matrices(ratio, sums, confidence)
    if gain.low is None:
        return replace(found, reason=gain.reason)
    return replace(found, gain_low=gain.low, gain_high=gain.high, p_value=_p_value(gain, len(counts), confidence))


def _p_value(estimate: Estimate, n_matrices: int, confidence: float) -> float:
    """Two-sided p-value of zero, from the t interval that it belongs to."""
    assert estimate.value is not None
    assert estimate.high is not None
    half = estimate.high - estimate.value
    error = half / student.half_width(confidence, n_matrices - 1)
    return student.two_sided(estimate.value / error, n_matrices - 1) if error else float(estimate.value == 0)


def parameter(fit: Fit, which: int, counts: np.ndarray, confidence: float) -> Estimate:
    """An internal parameter with its jackknife-t interval over matrices; parameters on a bound stay there.

    Raises
    ------
    Undefined
        If it is on a bound itself, there is one matrix, or the likelihood is flat.
    """
    if which not in fit.free:
        raise Undefined(f"border: {fit.border}")
    n = len(counts)
    if n < 2:
        raise Undefined("one matrix")
    score, information = derivatives(fit.family, fit.sizes, fit.theta, fit.free)
    scores = counts @ score
    informations = np.tensordot(counts, information, 1)
    rest = informations.sum(axis=0) - informations
    try:
        moved = -np.linalg.solve(rest, scores[:, :, None])[:, fit.free.index(which), 0]
    except np.linalg.LinAlgError:
        raise Undefined("flat likelihood") from None
    half = student.half_width(confidence, n - 1) * jackknife_error(moved)
    value = float(fit.theta[which])
    return Estimate(value, value - half, value + half)


def _judged(found: list[Rival], level: float) -> list[Rival]:
    """p-values adjusted for the number of rivals, and the verdicts that follow."""
    tested = [k for k, one in enumerate(found) if one.p_value is not None]
    out = list(found)
    for k, p in zip(tested, holm([found[k].p_value or 0.0 for k in tested]), strict=True):
        verdict = "as good" if p > level else "better" if (found[k].gain or 0.0) > 0 else "worse"
        out[k] = replace(found[k], p_adjusted=float(p), verdict=verdict)
    return out
