"""Roots of polynomials in (0, 1], none missed."""

from __future__ import annotations

import math

import numpy as np

from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.arithmetic import room

#: The most bisections of the unit interval in the search for a root; two roots closer than that count as a touch
_MAX_DEPTH = 44
_MAX_DEGREE = 40
#: The columns of an interval on the stack: its coefficients, then its lower end and its width.
_LOW, _WIDTH = _MAX_DEGREE + 1, _MAX_DEGREE + 2
_ROWS, _COLUMNS = _MAX_DEPTH + 2, _MAX_DEGREE + 3
_NARROWEST = 0.5**_MAX_DEPTH
#: As shares of an interval: how near to an end Newton's method begins, and its last step, at most.
_INSIDE, _SMALL = 1e-3, 1e-6
#: The error of a root that it ends with, over the root, and its most steps.
_ROUNDING, _MOST_STEPS = 2.2e-16, 1000


#: Pascal's triangle; exact in float64 up to row 56
BINOMIALS = np.array([[float(math.comb(i, j)) for j in range(_MAX_DEGREE + 1)] for i in range(_MAX_DEGREE + 1)])


@inner
def to_bernstein(coefficients: Floats, degree: int, bernstein: Floats) -> None:
    """Power basis on [0, 1] to Bernstein basis: b_j = sum_{k<=j} C(j,k) / C(degree,k) a_k, by running sums.

    Each from one place further left than the one before. Two go over the coefficients together, which takes half of
    the time.
    """
    for k in range(degree + 1):
        bernstein[k] = coefficients[k] / BINOMIALS[degree, k]
    for k in range(degree, 1, -2):
        inner_sum = bernstein[k - 1]
        outer_sum = bernstein[k - 2] + inner_sum
        bernstein[k - 1] = outer_sum
        for j in range(k, degree + 1):
            inner_sum += bernstein[j]
            outer_sum += inner_sum
            bernstein[j] = outer_sum
    if degree % 2 == 1:
        for j in range(1, degree + 1):
            bernstein[j] += bernstein[j - 1]


@inner
def horner(coefficients: Floats, degree: int, x: float) -> float:
    """Value of a polynomial."""
    value = coefficients[degree]
    for k in range(degree - 1, -1, -1):
        value = value * x + coefficients[k]
    return value


@inner
def _sign_changes(bernstein: Floats, degree: int) -> int:
    changes = 0
    last = 0.0
    for j in range(degree + 1):
        if bernstein[j] != 0.0:
            if last != 0.0 and (last < 0.0) != (bernstein[j] < 0.0):  # their product may underflow
                changes += 1
            last = bernstein[j]
    return changes


@inner
def _crossing(bernstein: Floats, degree: int) -> float:
    """Where the polygon of Bernstein coefficients, which change their sign once and not at an end, passes zero."""
    side = 1.0 if bernstein[0] > 0.0 else -1.0
    j = 0
    while j < degree - 1 and side * bernstein[j + 1] > 0.0:
        j += 1
    x = (j + bernstein[j] / (bernstein[j] - bernstein[j + 1])) / degree
    return min(x, 1.0 - _INSIDE) if x > _INSIDE else _INSIDE


@inner
def refine(coefficients: Floats, degree: int, low: float, high: float, rises: bool, x: float) -> float:
    """The one root in (low, high), to rounding: Newton's method from x, kept inside a shrinking bracket.

    The caller says whether the polynomial rises through it: at an end that is a root itself, its value does not tell.
    Every eighth step is a bisection, as it may come nearer by a small share at a time. A step leaves an error of its
    square times the curvature over the slope, if it is so small that higher powers do not matter: the last one is not
    checked by another.
    """
    small = _SMALL * (high - low)
    for n_steps in range(_MOST_STEPS):
        value, slope, curvature = coefficients[degree], 0.0, 0.0
        for k in range(degree - 1, -1, -1):
            curvature = curvature * x + slope
            slope = slope * x + value
            value = value * x + coefficients[k]
        if value == 0.0:
            return x
        if (value < 0.0) == rises:
            low = x
        else:
            high = x
        new = x - value / slope if slope != 0.0 else low
        if n_steps % 8 == 7 or not (low < new < high):
            new = 0.5 * (low + high)
            if new in (low, high):
                return new
        else:
            step, rounding = abs(new - x), _ROUNDING * abs(new)
            is_last = step <= min(small, abs(new)) and abs(curvature) * step * step <= rounding * abs(slope)
            if is_last or step <= rounding:
                return new
        x = new
    return x


@inner
def roots(coefficients: Floats, degree: int, places: Floats) -> int:
    """Roots in (0, 1] of a polynomial in the power basis with a_0 != 0, in rising order.

    By Descartes' rule in the Bernstein basis: an interval whose coefficients do not change sign holds no
    root, one change means exactly one root, more are bisected. So two roots close together are both found;
    where a polynomial only touches zero, rounding decides between two roots, one at the touch, and none.

    Returns the number of roots, which are in `places`; at most as many are looked for as fit there.
    """
    stack = room(_ROWS, _COLUMNS)
    n_found = 0
    to_bernstein(coefficients, degree, stack[0])
    stack[0, _LOW], stack[0, _WIDTH] = 0.0, 1.0
    top = 0
    while top >= 0:
        changes = _sign_changes(stack[top], degree)
        low, width = stack[top, _LOW], stack[top, _WIDTH]
        at_end = stack[top, degree] == 0.0 and changes == 0 and width >= _NARROWEST
        if changes == 0:
            top -= 1
            if not at_end:
                continue
            root = low + width
        elif changes == 1 and stack[top, 0] != 0.0 and stack[top, degree] != 0.0:
            top -= 1
            start = low + width * _crossing(stack[top + 1], degree)
            root = refine(coefficients, degree, low, low + width, stack[top + 1, 0] < 0.0, start)
        elif width <= _NARROWEST:
            top -= 1
            root = low
        else:
            # de Casteljau: the left half goes on top of the right half
            right = stack[top]
            left = stack[top + 1]
            for j in range(degree + 1):
                left[j] = right[0]
                for k in range(degree - j):
                    right[k] = 0.5 * (right[k] + right[k + 1])
            right[_LOW], right[_WIDTH] = low + 0.5 * width, 0.5 * width
            left[_LOW], left[_WIDTH] = low, 0.5 * width
            top += 1
            continue
        if n_found == 0 or root > places[n_found - 1]:
            places[n_found] = root
            n_found += 1
            if n_found == len(places):
                return n_found
    return n_found


@inner
def insert_roots(poly: Floats, degree: int, marks: Floats, n_marks: int, places: Floats) -> int:
    """Insert the roots of a polynomial in (0, 1] among `n_marks` places in rising order; returns how many there are.

    A root at the start belongs to the step before, and is left out. `places` is work space.
    """
    skip = 0
    while skip < degree and poly[skip] == 0.0:
        skip += 1
    for j in range(roots(poly[skip:], degree - skip, places)):
        k = n_marks
        while k > 0 and marks[k - 1] > places[j]:
            marks[k] = marks[k - 1]
            k -= 1
        marks[k] = places[j]
        n_marks += 1
    return n_marks
