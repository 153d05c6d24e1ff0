"""A string of blocks that is drawn along through a spring and rubs at one block, seen from the ground, by SciPy."""

import numpy as np
from scipy.integrate import solve_ivp


def bit_events(stiffness, damping, mass, friction, drive, bit, speed, t_end, static=None):
    """Times at which the block `bit` begins to slip (mode 1 or -1) or to stick (0), event by event.

    At the start all move at a speed but the bit, which rests.

    x'' = (-C x' - K x + pull - friction) / m on the ground, where the ground itself rests. `drive` gives the block
    that is pulled, the stiffness and the dashpot between, and where the drive is and how fast at a time.
    """
    n, (block, spring, dashpot, place, pace) = len(mass), drive
    static = friction if static is None else static

    def force(t, state):
        x, v = state[:n], state[n:]
        total = -stiffness @ x - damping @ v
        total[block] += spring * (place(t) - x[block]) + dashpot * (pace(t) - v[block])
        return total

    def motion(mode):
        def rates(t, state):
            total = force(t, state)
            total[bit] = 0.0 if mode == 0 else total[bit] - mode * friction
            return np.concatenate([state[n:], total / mass])

        return rates

    def leaves(t, state):
        return static - abs(force(t, state)[bit])

    def stops(t, state):
        return state[n + bit]

    leaves.terminal = stops.terminal = True
    leaves.direction = -1
    t, state, mode, events = 0.0, np.zeros(2 * n), 0, []
    state[n:] = speed
    state[n + bit] = 0.0
    while t < t_end:
        stops.direction = -mode
        run = solve_ivp(motion(mode), (t, t_end), state, "DOP853", events=leaves if mode == 0 else stops,
                        rtol=1e-12, atol=1e-13 * speed)  # fmt: skip
        t, state = run.t[-1], run.y[:, -1].copy()
        if run.status != 1:
            break
        pull = force(t, state)[bit]
        if mode:
            state[n + bit] = 0.0
        mode = int(np.sign(pull)) if mode == 0 or abs(pull) > static else 0
        events.append((t, mode))
    return events
