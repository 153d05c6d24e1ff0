"""Episodes split into connected clusters: against a search by hand, sums over episodes, and pairs of far chains."""

import numpy as np
import pytest

from stickslip import System, simulate
from stickslip.sim.episodes import clusters, episodes


def chain(n, rng, gap=None):
    """A chain with random static friction; `gap` leaves out the spring after one block."""
    tie = np.full(n - 1, 4.0)
    if gap is not None:
        tie[gap] = 0.0
    k = np.diag(1.0 + np.append(tie, 0.0) + np.append(0.0, tie)) - np.diag(tie, 1) - np.diag(tie, -1)
    return System(stiffness=k, damping=0.0, friction=1.0, static=rng.uniform(1.1, 1.5, n), belt_speed=-0.02)


def split(system, rng, t_end=400.0):
    z0 = rng.uniform(-0.2, 0.2, system.n)
    run = simulate(system, z0, system.belt_speed, t_end=t_end, engine="coulomb", tol=1e-9)
    found = episodes(run, system.belt_speed)
    times = np.unique(np.append(found.start, found.end))
    z = simulate(system, z0, system.belt_speed, t_end=t_end, engine="coulomb", tol=1e-9, t_eval=times).samples.z
    before, after = (z[np.searchsorted(times, at)] for at in (found.start, found.end))
    return run, found, before, after, clusters(run, system, before, after)


def by_hand(run, system, start, end):
    """Clusters of an episode as sets of blocks, by a search along springs, with first slips and last events."""
    stiffness = system.stiffness if isinstance(system.stiffness, np.ndarray) else system.stiffness.toarray()
    first, last = {}, {}
    for t, block, mode in zip(run.events.t, run.events.block, run.events.mode, strict=True):
        if start <= t <= end:
            if mode:
                first.setdefault(block, t)
            last[block] = t
    left, parts = set(first), []
    while left:
        part, edge = set(), [min(left)]
        while edge:
            block = edge.pop()
            if block in left:
                left.discard(block)
                part.add(block)
                edge += np.flatnonzero((stiffness[block] != 0) | (stiffness[:, block] != 0)).tolist()
        at, site = min((first[block], block) for block in part)
        parts.append((at, site, max(last[block] for block in part), sorted(part)))
    return sorted(parts)


@pytest.mark.parametrize("kind", ["chain", "two chains", "dense"])
def test_clusters_are_what_a_search_finds_and_add_up_to_episodes(kind, rng):
    n = 12
    system = chain(n, rng, 5 if kind == "two chains" else None)
    if kind == "dense":  # all are tied
        system = system.changed(stiffness=(1.0 + 0.5 * n) * np.eye(n) - 0.5)
    run, found, before, after, parts = split(system, rng)
    assert len(found) > 5
    k, row = 0, 0
    slip = after - before - system.belt_speed * (found.end - found.start)[:, None]
    for episode, (start, end) in enumerate(zip(found.start, found.end, strict=True)):
        for at, site, until, blocks in by_hand(run, system, start, end):
            assert (parts.episode[k], parts.start[k], parts.end[k]) == (episode, at, until)
            assert (parts.first_block[k], parts.size[k]) == (site, len(blocks))
            inside = slice(row, row + len(blocks))
            assert parts.profile_block[inside].tolist() == blocks
            assert set(parts.profile_cluster[inside]) == {k}
            assert parts.profile_slip[inside] == pytest.approx(slip[episode, blocks], abs=1e-12)
            fall = [system.stiffness[block] @ slip[episode] for block in blocks]
            assert parts.stress_drop[k] == pytest.approx(np.mean(fall), abs=1e-12)
            k, row = k + 1, row + len(blocks)
        others = np.setdiff1d(np.arange(n), parts.profile_block[parts.episode[parts.profile_cluster] == episode])
        assert slip[episode, others] == pytest.approx(0.0, abs=1e-7)  # they stick: to the tolerance of the run
    assert (k, row) == (len(parts.episode), len(parts.profile_slip))
    moments = np.bincount(parts.episode, parts.moment, len(found))
    assert moments == pytest.approx(found.moment, abs=1e-9)
    assert np.bincount(parts.episode, parts.size, len(found)).tolist() == found.size.tolist()
    if kind == "two chains":
        sides = parts.profile_block > 5
        assert all(len(set(sides[parts.profile_cluster == number])) == 1 for number in range(k))


def test_a_run_without_episodes_has_no_clusters(rng):
    system = chain(4, rng)
    _, found, _, _, parts = split(system, rng, t_end=0.1)
    assert len(found) == len(parts.episode) == len(parts.profile_slip) == 0
