"""Dormand and Prince's method of order 5(4) with events, for the exact law, as a user would write it with numba.

A step is taken as if no mode changed. If event functions are negative at its end, the first of their roots is found
on the continuous extension, of order four: there that block changes its mode, and the next step begins. An event that
a step jumps over, as a short stick, is lost.

E. Hairer, S. P. Norsett and G. Wanner, Solving Ordinary Differential Equations I, 2nd ed., II.5 and II.6.
"""

from __future__ import annotations

import numba
import numpy as np

# Row 6 holds the weights of the solution too, ERROR those of its difference from that of order four, DENSE the
# weights of theta, ..., theta^4 in the continuous extension.
STAGES = np.array(
    [
        [0, 0, 0, 0, 0, 0],
        [1 / 5, 0, 0, 0, 0, 0],
        [3 / 40, 9 / 40, 0, 0, 0, 0],
        [44 / 45, -56 / 15, 32 / 9, 0, 0, 0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0],
        [35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ]
)
ERROR = np.array([71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])
DENSE = np.array(
    [
        [1, -8048581381 / 2820520608, 8663915743 / 2820520608, -12715105075 / 11282082432],
        [0, 0, 0, 0],
        [0, 131558114200 / 32700410799, -68118460800 / 10900136933, 87487479700 / 32700410799],
        [0, -1754552775 / 470086768, 14199869525 / 1410260304, -10690763975 / 1880347072],
        [0, 127303824393 / 49829197408, -318862633887 / 49829197408, 701980252875 / 199316789632],
        [0, -282668133 / 205662961, 2019193451 / 616988883, -1453857185 / 822651844],
        [0, 40617522 / 29380423, -110615467 / 29380423, 69997945 / 29380423],
    ]
)
#: The least share of a step that it takes to an event, so that a run goes on.
LEAST = 1e-9


@numba.njit
def rates(numbers, mode, y, rate, pull):  # type: ignore[no-untyped-def]
    """(z, w)' into `rate`, and F = R v + K z of blocks at their belt's speed v."""
    (stiffness, damping, friction, v), n = numbers, len(mode)
    np.dot(stiffness, y[:n], pull)
    for i in range(n):
        rate[i] = v if mode[i] == 0 else y[n + i]
        rate[n + i] = 0.0 if mode[i] == 0 else -(damping[i] * y[n + i] + pull[i] + friction[i] * mode[i])
        pull[i] += damping[i] * v


@numba.njit
def extend(k, slopes):  # type: ignore[no-untyped-def]
    """The coefficients of theta, ..., theta^4 of the continuous extension, over h."""
    for i in range(len(slopes)):
        for power in range(4):
            total = 0.0
            for j in range(7):
                total += DENSE[j, power] * k[j, i]
            slopes[i, power] = total


@numba.njit
def quartic(q, x):  # type: ignore[no-untyped-def]
    return q[0] + x * (q[1] + x * (q[2] + x * (q[3] + x * q[4])))


@numba.njit
def root(q, high):  # type: ignore[no-untyped-def]
    """The point in (0, high] at which a quartic that is negative at `high` became so: regula falsi, Illinois."""
    low, at_high = LEAST * high, quartic(q, high)
    at_low = quartic(q, low)
    if at_low <= 0.0:
        return low
    for _ in range(60):
        x = (low * at_high - high * at_low) / (at_high - at_low)
        at_x = quartic(q, x)
        if at_x > 0.0:
            low, at_low, at_high = x, at_x, 0.5 * at_high
        else:
            high, at_high, at_low = x, at_x, 0.5 * at_low
        if high - low < 1e-14 or at_x == 0.0:
            break
    return x


@numba.njit
def attempt(numbers, mode, y, h, tol, k, end, pull):  # type: ignore[no-untyped-def]
    """A step of size h from y to `end` by the stages 1 to 6 of `k`: the sum of its squared errors over `tol`."""
    for stage in range(1, 7):
        for i in range(len(y)):
            total = 0.0
            for j in range(stage):
                total += STAGES[stage, j] * k[j, i]
            end[i] = y[i] + h * total
        rates(numbers, mode, end, k[stage], pull)
    norm = 0.0
    for i in range(len(y)):
        error = 0.0
        for j in range(7):
            error += ERROR[j] * k[j, i]
        norm += (h * error / (tol * (1.0 + max(abs(y[i]), abs(end[i]))))) ** 2
    return norm


@numba.njit(cache=True)
def run(stiffness, damping, friction, v, y, mode, t_end, tol, most):  # type: ignore[no-untyped-def]
    """Take y = (z, w), shape (2 n,), and the modes to t_end, in place.

    Returns the products of K, -1 if `most` steps did not do, and the events: times, blocks, modes.
    """
    n, t, h, numbers = len(mode), 0.0, 0.01, (stiffness, damping, friction, v)
    k, f, end, q = np.zeros((7, 2 * n)), np.empty((2, n)), np.empty(2 * n), np.empty(5)
    slopes, times, blocks, modes = np.empty((2 * n, 4)), [t], [n], [n]
    rates(numbers, mode, y, k[0], f[0])
    products = 1
    for _ in range(most):
        if t >= t_end:
            return products, times[1:], blocks[1:], modes[1:]
        h = min(h, t_end - t)
        norm = attempt(numbers, mode, y, h, tol, k, end, f[1])
        products += 6
        factor = min(10.0, max(0.2, 0.9 * max(norm / (2 * n), 1e-20) ** -0.1))
        if norm > 2 * n:
            h *= factor
            continue
        theta, block, is_dense = 1.0, -1, False
        for i in range(n):
            side = mode[i] if mode[i] != 0 else (-1 if f[1, i] > 0.0 else 1)
            if (mode[i] != 0 and side * (end[n + i] - v) < 0.0) or (mode[i] == 0 and abs(f[1, i]) > friction[i]):
                if not is_dense:
                    is_dense = True
                    extend(k, slopes)
                q[:] = 0.0
                if mode[i] != 0:
                    q[0] = side * (y[n + i] - v)
                    for power in range(4):
                        q[1 + power] = side * h * slopes[n + i, power]
                else:
                    q[0] = friction[i] + side * f[0, i]
                    for j in range(n):
                        for power in range(4):
                            q[1 + power] += side * h * stiffness[i, j] * slopes[j, power]
                if quartic(q, theta) < 0.0:
                    theta, block = root(q, theta), i
        if block < 0:
            t, y[:], k[0], f[0] = t + h, end, k[6], f[1]
            h *= factor
            continue
        for i in range(2 * n):
            y[i] += (
                h * theta * (slopes[i, 0] + theta * (slopes[i, 1] + theta * (slopes[i, 2] + theta * slopes[i, 3])))
            )
        t += theta * h
        force = damping[block] * v
        for j in range(n):
            force += stiffness[block, j] * y[j]
        is_entry = mode[block] != 0 and abs(force) < friction[block]
        mode[block] = 0 if is_entry else (-1 if force > 0.0 else 1)
        y[n + block] = v
        times.append(t)
        blocks.append(block)
        modes.append(mode[block])
        rates(numbers, mode, y, k[0], f[0])
        products += 1
    return -1, times[1:], blocks[1:], modes[1:]
