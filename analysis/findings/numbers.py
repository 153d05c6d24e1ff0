"""Numbers with their intervals as texts: two digits of the half-width of an interval, the same in value and ends."""

from __future__ import annotations

import math
from collections.abc import Iterable

from stickslip.analysis import arguments
from stickslip.analysis.findings.finding import Form
from stickslip.analysis.stats.estimates import Estimate

MINUS = "\u2212"
MOST_DIGITS = 9  # of a share that is nearly all
DIGITS = 3  # of a number without an interval
SAME = 1e-6  # relative width of an interval that is none: all units have the same value
MOST_DECIMALS, MOST_PLACES = 6, 12  # beyond, a number is written with a power of ten
_ROUNDING = 1e-12
_SUPERSCRIPTS = str.maketrans("-0123456789", "\u207b\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079")


def signs(text: str) -> str:
    """A text with the hyphens that begin a word, which are signs of numbers, as minus signs."""
    for before in (" ", "(", "["):
        text = text.replace(f"{before}-", f"{before}{MINUS}")
    return MINUS + text[1:] if text.startswith("-") else text


def decimals(estimate: Estimate, form: Form = Form.NUMBER) -> int:
    """Decimals that leave two digits of the half-width of an interval, or three of a number without one."""
    scale = _scale(form)
    if estimate.low is not None and estimate.high is not None and not is_exact(estimate):
        return max(0, 1 - _exponent((estimate.high - estimate.low) / 2 * scale))
    if form is Form.COUNT:
        return 0
    size = max((abs(x) for x in (estimate.value, estimate.low, estimate.high) if x is not None), default=0.0)
    return max(0, DIGITS - 1 - _exponent(size * scale)) if size else 0


def _exponent(size: float) -> int:
    """The power of ten of the first digit of a size, after it has been rounded to two digits."""
    return math.floor(math.log10(float(f"{size:.1e}")))


def _scale(form: Form) -> float:
    return 100.0 if form in (Form.SHARE, Form.POINTS) else 1.0


def to_error(value: float, error: float) -> str:
    """A number with the digits of an interval as wide as twice its error: the last digit is about that width.

    With four digits if it has no error, or an unknown one.
    """
    if not error > 0.0:
        return f"{value:.4g}"
    places = max(0, round(-math.log10(2.0 * error)))
    return f"{value:.{places}f}"


def number(value: float, form: Form = Form.NUMBER, digits: int | None = None, sign: bool = False) -> str:
    """A number with so many decimals, of a share in per cent; by default with three digits."""
    return bare(value, form, digits, sign) + "%" * (form is Form.SHARE)


def bare(value: float, form: Form = Form.NUMBER, digits: int | None = None, sign: bool = False) -> str:
    """A number as of `number`, without its unit."""
    scaled = value * _scale(form) + 0.0
    places = decimals(Estimate(value), form) if digits is None else digits
    while form is Form.SHARE and value < 1.0 and round(scaled, places) == 100.0 and places < MOST_DIGITS:
        places += 1  # what is not all is not said to be
    while form is Form.SHARE and value > 0.0 and round(scaled, places) == 0.0 and places < MOST_DIGITS:
        places += 1  # nor what is not none
    power = _exponent(abs(scaled)) if scaled else 0
    if (places > MOST_DECIMALS and scaled) or power >= MOST_PLACES:
        shown = max(1, places + power) if power < MOST_PLACES else DIGITS - 1
        text = f"{scaled / 10.0**power:.{shown}f} \u00d7 10{str(power).translate(_SUPERSCRIPTS)}"
    else:
        text = f"{scaled:,.{places}f}"
    if round(scaled, places) == 0.0:
        text = text.lstrip("-")  # minus zero is zero
    return ("+" if sign and round(scaled, places) > 0.0 else "") + text.replace("-", MINUS)


def span(low: float, high: float, form: Form = Form.NUMBER, sign: bool = False, digits: int | None = None) -> str:
    """Two ends, "0.697 to 0.702" or "28.8 to 31.4%", by default with two digits of half their distance."""
    n_digits = decimals(Estimate(low=low, high=high), form)
    places = n_digits if digits is None else digits
    while places < n_digits and bare(low, form, places, sign) == bare(high, form, places, sign):
        places += 1
    ends = (bare(end, form, places, sign) for end in (low, high))
    return " to ".join(ends) + "%" * (form is Form.SHARE)


def is_exact(estimate: Estimate) -> bool:
    """Whether an interval has no width: all units have the same value."""
    low, high = estimate.low, estimate.high
    return low is not None and high is not None and high - low <= SAME * max(abs(low), abs(high))


def limit(most: float, form: Form = Form.NUMBER) -> str:
    """An upper limit with two digits, rounded up, so that it holds."""
    places = max(0, decimals(Estimate(most), form) - 1)
    unit = _scale(form) * 10.0**places
    return number(math.ceil(most * unit * (1.0 - _ROUNDING)) / unit, form, places)


def with_interval(estimate: Estimate, form: Form = Form.NUMBER, digits: int | None = None, sign: bool = False) -> str:
    """An estimate in a sentence: "0.700 (0.697 to 0.702)"; with one end, "206 (at least 150)"; else without.

    A limit without an estimate is "at most 0.3%".

    Raises
    ------
    ValueError
        If it is no `Estimate`, or one without a value or an upper limit.
    """
    estimate = arguments.instance("estimate", estimate, Estimate)
    low, high = estimate.low, estimate.high
    if estimate.value is None and high is not None:
        return f"at most {limit(high, form)}"
    if estimate.value is None:
        raise ValueError(f"estimate: expected a value, got {estimate!r}; say what is lacking instead")
    value = number(estimate.value, form, decimals(estimate, form) if digits is None else digits, sign)
    if low is not None and high is not None:
        return value if is_exact(estimate) else f"{value} ({span(low, high, form, sign, digits)})"
    if low is not None:
        return f"{value} (at least {number(low, form, digits)})"
    if high is not None:
        return f"{value} (at most {number(high, form, digits)})"
    return value


def alike(estimates: Iterable[Estimate], form: Form) -> int:
    """The decimals of a column: as many as its most precise estimate needs, but for one that stands out."""
    places = sorted(decimals(estimate, form) for estimate in estimates if estimate.value is not None)
    return min(places[-1], places[len(places) // 2] + 1) if places else 0
