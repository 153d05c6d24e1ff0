"""An independent method for the smoothed law: Radau IIA of seven stages, order 13, on steps of its own.

    z'' + R z' + N z' + K z + mu s(tanh((z' - v) / delta)) g(|z' - v|) = 0,    s(l) = l + c l (1 - l^2)

c is such that the largest mu s is static friction: 4 (1 + c)^3 = 27 r^2 c, r static over kinetic; 0 if they are one.
g = 1, 1 / (1 + a u), or f + (1 - f) exp(-a u); then mu is static friction, f kinetic over that, and c = 0. On a side
that is closed the law is its tangent at z' = v.

It shares nothing with `sim` but the names of laws. Nodes and weights are computed here from Legendre polynomials.
Each block's seven values of w are found by Newton's method with the rest of the motion fixed, and all blocks are
swept until nothing moves. A step is taken when both the last two Legendre coefficients of w' and the defect of the
polynomial, at 28 places between the nodes, are below the tolerance, in w.
"""

import numba
import numpy as np
from numpy.polynomial import legendre

from stickslip.sim import Stribeck

STAGES = 7
_FINE = 28


def _tables():
    """A, A^-1, on the fine places w from (w_0, w_k) and w' from w'_k, the last two Legendre coefficients of w'."""
    radau = legendre.legsub([0.0] * STAGES + [1.0], [0.0] * (STAGES - 1) + [1.0])
    c = (np.sort(legendre.legroots(radau).real) + 1.0) / 2.0
    c[-1] = 1.0
    x = 2.0 * c - 1.0
    inverse = np.linalg.inv(legendre.legvander(x, STAGES - 1))  # to Legendre's coefficients: powers lose six digits
    integrals = legendre.legint(np.eye(STAGES), lbnd=-1.0, scl=0.5)
    a = legendre.legval(x, integrals).T @ inverse
    fine = 2.0 * (np.arange(_FINE) + 0.5) / _FINE - 1.0
    rates = legendre.legvander(fine, STAGES - 1) @ inverse
    with_start = np.concatenate(([-1.0], x))
    values = legendre.legvander(fine, STAGES) @ np.linalg.inv(legendre.legvander(with_start, STAGES))
    return a, np.linalg.inv(a), values, rates, np.ascontiguousarray(inverse[-2:])


TABLES = _tables()


@numba.njit(cache=True)
def _product(a, b, is_turned, product):
    """a b, or a b^T, by plain loops, which take a fraction of the time to compile that those of NumPy do."""
    for i in range(a.shape[0]):
        for j in range(product.shape[1]):
            total = 0.0
            for k in range(a.shape[1]):
                total += a[i, k] * (b[j, k] if is_turned else b[k, j])
            product[i, j] = total


@numba.njit(cache=True)
def _moved(x, before):
    """The largest change, and the largest |x|."""
    change, size = 0.0, 0.0
    for k in range(x.shape[0]):
        for i in range(x.shape[1]):
            change, size = max(change, abs(x[k, i] - before[k, i])), max(size, abs(x[k, i]))
    return change / max(1.0, size)


@numba.njit(cache=True)
def _solve(matrix, x):
    """x = matrix^-1 x, by elimination with pivots; `matrix` is overwritten."""
    n = len(x)
    for k in range(n):
        p = k
        for i in range(k + 1, n):
            if abs(matrix[i, k]) > abs(matrix[p, k]):
                p = i
        if p != k:
            for j in range(n):
                matrix[k, j], matrix[p, j] = matrix[p, j], matrix[k, j]
            x[k], x[p] = x[p], x[k]
        for i in range(k + 1, n):
            factor = matrix[i, k] / matrix[k, k]
            for j in range(k, n):
                matrix[i, j] -= factor * matrix[k, j]
            x[i] -= factor * x[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            x[k] -= matrix[k, j] * x[j]
        x[k] /= matrix[k, k]


@numba.njit(cache=True)
def _sign(u, delta, law):
    """Friction over mu at the speed of slip u, and its slope; `law` is c, f, a, which g it is, the closed side."""
    c, far, a, kind, closed = law
    x = u / delta
    if x * closed > 0.0:
        return (1.0 + c) * x, (1.0 + c) / delta
    tanh = np.tanh(x)
    rise = 1.0 - tanh * tanh
    s, slope = tanh * (1.0 + c * rise), rise * (1.0 + c * rise - 2.0 * c * tanh * tanh) / delta
    g, falls = 1.0, 0.0
    if kind == 1:
        g = 1.0 / (1.0 + a * abs(u))
        falls = -a * g * g
    elif kind == 2:
        g = np.exp(-a * abs(u))
        falls = -a * (1.0 - far) * g
        g = far + (1.0 - far) * g
    return s * g, slope * g + abs(s) * falls


@numba.njit(cache=True)
def _block(h, w0, force, r, mu, law, v, delta, w, a_inverse):
    """Newton's method for the values of w of one block at the nodes; False if it does not settle."""
    s = len(w)
    matrix, change = np.empty((s, s)), np.empty(s)
    last = np.inf
    for _ in range(60):
        for k in range(s):
            sign, slope = _sign(w[k] - v, delta, law)
            total = 0.0
            for j in range(s):
                matrix[k, j] = a_inverse[k, j]
                total += a_inverse[k, j] * (w[j] - w0)
            change[k] = total + h * (r * w[k] + force[k] + mu * sign)
            matrix[k, k] += h * (r + mu * slope)
        _solve(matrix, change)
        size, largest = 0.0, 1.0
        for k in range(s):
            size = max(size, abs(change[k]))
            w[k] -= change[k]
            largest = max(largest, abs(w[k]))
        if not size < 1e6:
            return False
        if size <= 1e-15 * largest or (size < 1e-13 and size >= last):
            return True
        last = size
    return False


@numba.njit(cache=True)
def _step(h, z0, w0, k_matrix, cross, r, mu, laws, v, delta, z, w, force, tables):
    """One trial step. Returns the largest weighted defect, or infinity; z, w are values at the nodes."""
    a, a_inverse, values, rates, tails = tables
    s, n = w.shape
    column, rate_at, pull = np.empty(s), np.empty(s), np.empty(s)
    before, new_z, by_cross = np.empty((s, n)), np.empty((s, n)), np.empty((s, n))
    last = np.inf
    settled = False
    for k in range(s):
        for i in range(n):
            w[k, i] = w0[i]
    for _ in range(60):
        _product(a, w, False, new_z)
        for k in range(s):
            for i in range(n):
                new_z[k, i] = z0[i] + h * new_z[k, i]
        moved = _moved(new_z, z)
        z[:] = new_z
        _product(z, k_matrix, True, force)
        _product(w, cross, True, by_cross)
        before[:] = w
        for i in range(n):
            for k in range(s):
                force[k, i] += by_cross[k, i]
                column[k], pull[k] = w[k, i], force[k, i]
            is_solved = False
            for attempt in range(2):
                if not is_solved:
                    if attempt == 1:
                        column[:] = v  # once more, from the belt
                    is_solved = _block(h, w0[i], pull, r[i], mu[i], laws[i], v, delta[i], column, a_inverse)
            if not is_solved:
                return np.inf
            for k in range(s):
                w[k, i] = column[k]
        moved = max(moved, _moved(w, before))
        if moved <= 2e-15 or (moved < 1e-13 and moved >= 0.5 * last):
            settled = True
            break
        last = moved
    if not settled:
        return np.inf
    _product(a, w, False, z)
    for k in range(s):
        for i in range(n):
            z[k, i] = z0[i] + h * z[k, i]
    worst = 0.0
    for i in range(n):
        for k in range(s):
            rate_at[k] = -(r[i] * w[k, i] + force[k, i] + mu[i] * _sign(w[k, i] - v, delta[i], laws[i])[0])
        for p in range(2):
            tail = 0.0
            for k in range(s):
                tail += tails[p, k] * rate_at[k]
            worst = max(worst, abs(h * tail) / max(1.0, abs(w0[i])))
        for p in range(values.shape[0]):
            speed, f, rate = values[p, 0] * w0[i], 0.0, 0.0
            for k in range(s):
                speed += values[p, k + 1] * w[k, i]
                f += rates[p, k] * force[k, i]
                rate += rates[p, k] * rate_at[k]
            sign, slope = _sign(speed - v, delta[i], laws[i])
            defect = h * (rate + r[i] * speed + f + mu[i] * sign)
            stiff = 1.0 + h * (abs(r[i]) + mu[i] * max(slope, 0.0))
            worst = max(worst, abs(defect) / stiff / max(1.0, abs(speed)))
    return worst


@numba.njit(cache=True)
def _run(k_matrix, cross, r, mu, laws, v, delta, z, w, times, tol, longest, tables, out):
    s, n = len(tables[0]), len(z)
    nodes_z, nodes_w, force = np.zeros((s, n)), np.empty((s, n)), np.empty((s, n))
    h, t, n_steps = 1e-4, 0.0, 0
    for m in range(len(times)):
        while t < times[m]:
            n_steps += 1
            if h < 1e-14 or n_steps > 100000:
                return -1
            step = min(h, longest, times[m] - t)
            for k in range(s):
                nodes_z[k] = z
            error = _step(step, z, w, k_matrix, cross, r, mu, laws, v, delta, nodes_z, nodes_w, force, tables)
            if error <= tol:
                t = times[m] if step == times[m] - t else t + step
                z[:] = nodes_z[s - 1]
                w[:] = nodes_w[s - 1]
                grow = 0.8 * (tol / max(error, 1e-30)) ** (1.0 / (s + 1))
                h = max(h if step < h else 0.0, step * min(2.5, max(0.5, grow)))
            else:
                h = step * (max(0.1, 0.8 * (tol / error) ** (1.0 / (s + 1))) if error < 1e6 else 0.25)
        out[m, 0] = z
        out[m, 1] = w
    return n_steps


def _hidden(static, kinetic):
    if static == kinetic:
        return 0.0
    return np.roots([4.0, 12.0, 12.0 - 27.0 * (static / kinetic) ** 2, 4.0]).real.max()


def states(system, z0, w0, delta, times, tol=1e-13, longest=0.05):
    """z and w at rising times, shape (m, 2, n); NaN if it could not be done."""
    n, k = system.n, system.stiffness
    dense = np.ascontiguousarray(k if isinstance(k, np.ndarray) else k.toarray())
    cross = np.zeros((n, n)) if system.cross_damping is None else np.ascontiguousarray(system.cross_damping)
    z, w, width = (np.array(np.broadcast_to(np.asarray(x, float), n)) for x in (z0, w0, delta))
    out = np.full((len(times), 2, n), np.nan)
    kind = 0 if system.weakening is None else 1 + isinstance(system.weakening, Stribeck)
    near = np.array(system.static if kind == 2 else system.friction)
    laws = np.zeros((n, 5))
    laws[:, 0] = [_hidden(*pair) for pair in zip(system.static, near, strict=True)]
    laws[:, 1] = np.divide(system.friction, near, out=np.zeros(n), where=near > 0)
    laws[:, 2] = (0.0, getattr(system.weakening, "rate", 0.0), 1.0 / getattr(system.weakening, "speed", 1.0))[kind]
    laws[:, 3], laws[:, 4] = kind, system.closed
    steps = _run(
        dense, cross, np.array(system.damping), near, laws, float(system.belt_speed), width,
        z, w, np.asarray(times, float), tol, longest, TABLES, out,
    )  # fmt: skip
    return out if steps >= 0 else np.full_like(out, np.nan)
