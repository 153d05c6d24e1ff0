"""Pictures of a run: what is drawn is what the run says, and a wrong question is answered in a line."""

from dataclasses import replace
from functools import cache

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from stickslip.analysis import pictures
from stickslip.sim import EventSeries, System, draw_system, simulate

T = np.linspace(0.0, 40.0, 2001)
SYSTEM = System(np.array([[2.0, -1.0], [-1.0, 2.0]]), 0.1, static=1.5, belt_speed=0.3)


@cache
def kept():
    """A run that is sampled; none is made while tests are collected, which would compile in one process."""
    return simulate(SYSTEM, 0.0, [0.5, -0.2], 40.0, t_eval=T)


def bare():
    return simulate(SYSTEM, 0.0, [0.5, -0.2], 40.0)


def at_rest(*t):
    return simulate(SYSTEM, 0.0, 0.0, 9.0, t_eval=t)


def draw_run(coupling, n):
    return simulate(draw_system(coupling, n=n, seed=3), -0.7, -0.4, 5.0)


#: Options that a kind cannot do without.
NEEDED = {"slip": {"width": 2}}


def axes():
    return Figure().subplots()


def random_series(rng, n, m, t_end=10.0):
    """Blocks that change between modes at random; the same mode never twice in a row."""
    t, block = np.sort(rng.uniform(2.0, t_end, m)), rng.integers(n, size=m)
    initial = rng.choice([-1, 0, 1], n)
    mode, now = np.empty(m, dtype=np.int8), initial.copy()
    for k in range(m):
        mode[k] = now[block[k]] = rng.choice([one for one in (-1, 0, 1) if one != now[block[k]]])
    return EventSeries(t, block.astype(np.int32), mode, initial.astype(np.int8), 2.0, t_end)


@pytest.mark.parametrize("rows", [750, 4])
def test_an_image_has_the_mean_colour_of_its_pixels(rng, monkeypatch, rows):
    """Against modes at many times of each pixel, looked up one by one."""
    monkeypatch.setattr(pictures, "_VECTORS", 0)
    monkeypatch.setattr(pictures, "_COLUMNS", 5)
    monkeypatch.setattr(pictures, "_ROWS", rows)
    series = random_series(rng, 7, 120)
    ax = series.plot(ax=axes(), span=(3.0, 8.0))
    (shown,) = ax.images
    drawn = np.asarray(shown.get_array())
    per = 1 if rows == 750 else 2
    fine = 4000
    modes = np.array([series.mode_at(t) for t in 3.0 + (np.arange(5 * fine) + 0.5) / fine])
    colours = np.array([to_rgb(pictures._MODES[mode][1]) for mode in (-1, 0, 1)])[modes + 1]  # times, blocks, 3
    for row in range(drawn.shape[0]):
        seen = colours[:, row * per : (row + 1) * per].mean(axis=1).reshape(5, fine, 3).mean(axis=1)
        np.testing.assert_allclose(drawn[row], seen, atol=120 / fine)
    assert shown.get_extent() == [3.0, 8.0, -0.5, 6.5 if per == 1 else 7.5]
    assert drawn.shape == (7 if per == 1 else 4, 5, 3)


def seldom(n, m, t_end=1e5, lasts=1e-3):
    """Blocks that slip m times each, all in turn, and so long each time."""
    block, start = np.tile(np.arange(n), m), (np.arange(n * m) + 0.5) * (t_end - lasts) / (n * m)
    t, mode = np.concatenate([start, start + lasts]), np.repeat(np.array([1, 0], dtype=np.int8), n * m)
    order = np.argsort(t, kind="stable")
    block = np.tile(block, 2)[order].astype(np.int32)
    return EventSeries(t[order], block, mode[order], np.zeros(n, np.int8), 0.0, t_end)


def coloured(image):
    """How much of the colour of a slip to the right each pixel of an image has."""
    sticks, slips = (np.array(to_rgb(pictures._MODES[mode][1])) for mode in (0, 1))
    return (np.asarray(image) - sticks) @ (slips - sticks) / np.sum((slips - sticks) ** 2)


@pytest.mark.parametrize(("n", "m"), [(10, 12), (100, 40)])
def test_slips_that_are_short_and_seldom_are_seen(n, m):
    """As rectangles and as an image: some are wide enough to be seen, and little else has their colour."""
    series = seldom(n, m)
    ax = series.plot(ax=axes())
    if ax.images:
        found = coloured(ax.images[0].get_array())
        assert found.mean() <= 0.2 + 1e-6
        is_exit = series.mode == 1
        at = series.t[is_exit] / 1e5 * found.shape[1]
        assert found[series.block[is_exit], at.astype(int)] == pytest.approx(1.0, abs=1e-6)
    else:
        (patch,) = [one for one in ax.patches if one.get_label() == "slips right"]
        widths = [np.ptp(one[:, 0]) for one in patch.get_path().to_polygons()]
        assert len(widths) == n * m
        assert min(widths) == pytest.approx(1e5 / pictures._SEEN)


def test_pixels_in_which_blocks_slip_either_way_have_both_colours():
    series = seldom(100, 60)
    is_left = (series.t // (1e5 / 60)).astype(int) % 2 == 1  # every other round of all blocks
    ways = np.where(is_left, -1, 1) * (series.mode != 0)
    image = np.asarray(replace(series, mode=ways.astype(np.int8)).plot(ax=axes()).images[0].get_array())
    blue, orange, grey = (np.array(to_rgb(pictures._MODES[mode][1])) for mode in (1, -1, 0))
    flat = image.reshape(-1, 3)
    weights = np.linalg.lstsq(np.stack([blue, orange, grey], axis=1), flat.T, rcond=None)[0]
    assert weights.min() > -1e-9
    assert weights.sum(axis=0) == pytest.approx(1.0)


def test_a_span_cuts_rectangles(rng, monkeypatch):
    """Where none is drawn wider than it is, so as to be seen, nothing is left to chance: areas add up to rounding."""
    monkeypatch.setattr(pictures, "_SEEN", np.inf)
    series = random_series(rng, 4, 30)
    ax = series.plot(ax=axes(), span=(4.0, 5.0))
    boxes_of = {
        patch.get_label(): [[*one.min(axis=0), *one.max(axis=0)] for one in patch.get_path().to_polygons()]
        for patch in ax.patches
    }
    boxes = [box for some in boxes_of.values() for box in some]
    assert sum((right - left) * (top - low) for left, low, right, top in boxes) == pytest.approx(4.0, rel=1e-12)
    assert {ax.get_xlim(), (min(b[0] for b in boxes), max(b[2] for b in boxes))} == {(4.0, 5.0)}
    middle = series.mode_at(4.5)
    for mode, (label, _) in pictures._MODES.items():
        here = {round((low + top) / 2) for left, low, right, top in boxes_of.get(label, []) if left <= 4.5 < right}
        assert here == set(np.flatnonzero(middle == mode))


def test_a_grid_is_numbered_by_rows():
    ax = draw_run("grid", 12).plot("space_time", ax=axes(), width=4)
    ticks = dict(zip((tick.get_text() for tick in ax.get_yticklabels()), ax.get_yticks(), strict=True))
    assert ticks == {"0": 1.5, "1": 5.5, "2": 9.5}  # blocks 0 to 3, 4 to 7, 8 to 11
    assert sorted(line.get_ydata()[0] for line in ax.lines) == [3.5, 7.5]


def test_a_map_of_slips_counts_the_exits_of_each_block():
    run = simulate(draw_system("grid", n=11, seed=3), np.linspace(-1.0, 1.0, 11), -0.2, 30.0)
    series = run.events
    ax = run.plot("slip", ax=axes(), width=4, span=(3.0, 30.0))
    (image,) = ax.images
    counts = [0] * 11
    mode = series.initial_mode.tolist()
    for t, block, after in zip(series.t, series.block.tolist(), series.mode.tolist(), strict=True):
        counts[block] += mode[block] == 0 and 3.0 <= t <= 30.0
        mode[block] = after
    found = image.get_array()
    assert found.shape == (3, 4)
    assert found.filled(-1).ravel().tolist() == [*counts, -1]
    assert sum(counts) > 0
    never = [(int(line.get_ydata()[0]), int(line.get_xdata()[0])) for line in ax.lines]
    assert never == [divmod(block, 4) for block, n in enumerate(counts) if n == 0]
    assert [text.get_text() for text in ax.texts] == [str(n) for n in counts if n]


@pytest.mark.parametrize("of", ["z", "w"])
def test_time_series_are_the_samples_and_broad_where_the_block_sticks(of):
    ax = kept().plot("time", ax=axes(), of=of, blocks=[1, 0])
    lines = [line for line in ax.lines if not line.get_label().startswith("_")]
    assert [line.get_label() for line in lines] == ["block 1", "block 0"]
    for block, line in zip((1, 0), lines, strict=True):
        t, value = line.get_data()
        at = np.isin(t, T)
        np.testing.assert_array_equal(value[at], (kept().samples.z if of == "z" else kept().samples.w)[:, block])
        assert at.sum() == len(T)
    for block, broad in zip((1, 0), (line for line in ax.lines if line.get_label() == "_sticks"), strict=True):
        t, value = broad.get_data()
        ends = np.isin(t, np.concatenate((kept().events.t, [0.0, 40.0])))
        sticks = np.array([kept().events.mode_at(one)[block] == 0 for one in t[~ends]])
        np.testing.assert_array_equal(~np.isnan(value[~ends]), sticks)
        assert sticks.any()
        assert not sticks.all()


def test_a_slip_between_two_samples_is_not_bridged():
    """Block 0 of `kept` sampled at so few times that whole slips lie between them."""
    coarse = simulate(SYSTEM, 0.0, [0.5, -0.2], 40.0, t_eval=[0.0, 40.0])
    ax = coarse.plot("time", ax=axes(), blocks=0)
    broad = next(line for line in ax.lines if line.get_label() == "_sticks")
    pieces = np.diff(np.isnan(broad.get_ydata()), prepend=True) & ~np.isnan(broad.get_ydata())
    stays = np.concatenate(([kept().events.initial_mode[0]], kept().events.mode[kept().events.block == 0])) == 0
    assert pieces.sum() == stays.sum() > 1


def test_a_phase_portrait_is_on_the_ellipse_of_a_block_that_slips_freely():
    """Without friction worth a word and without damping, w^2 + K z^2 is kept: K = 4, from z = 1 at rest."""
    run = simulate(
        System(np.array([[4.0]]), 0.0, friction=1e-12, belt_speed=-5.0), 1.0, 0.0, 6.0, t_eval=np.linspace(0, 6, 601)
    )
    line, _, start = run.plot("phase", ax=axes()).lines
    z, w = line.get_data()
    np.testing.assert_allclose(w**2 + 4 * z**2, 4.0, rtol=1e-9)
    assert (start.get_xdata()[0], start.get_ydata()[0]) == (1.0, 0.0)


def test_the_spectrum_of_a_vibration_is_a_peak_of_its_power():
    """A block without friction worth a word vibrates at sqrt(K) / (2 pi) with the variance A^2 / 2 of its speed."""
    frequency, amplitude = 2.0, 0.3
    stiffness = (2 * np.pi * frequency) ** 2
    run = simulate(
        System(np.array([[stiffness]]), 0.0, friction=1e-12, belt_speed=-5.0), 0.0, amplitude, 64.0,
        t_eval=np.linspace(0.0, 64.0, 4097),
    )  # fmt: skip
    (line,) = run.plot("spectrum", ax=axes(), block=0).lines
    f, density = line.get_data()
    assert f[np.argmax(density)] == pytest.approx(frequency, abs=f[1] - f[0])
    assert density.sum() * (f[1] - f[0]) == pytest.approx(amplitude**2 / 2, rel=0.01)


def test_the_spectrum_of_n_stick_is_that_of_a_square_wave():
    """One block sticks and slips by turns of 0.5: variance 1/4, line at 1 and its odd multiples k as 1 / k^2."""
    t = np.arange(1, 128) * 0.5
    mode = (np.arange(1, 128) % 2).astype(np.int8)
    series = EventSeries(t, np.zeros(127, np.int32), mode, np.zeros(1, np.int8), 0.0, 64.0)
    (line,) = series.plot("spectrum", ax=axes()).lines
    f, density = line.get_data()
    step = f[1] - f[0]
    power = {k: density[np.abs(f - k) < 0.3].sum() * step for k in (1, 2, 3, 5)}
    for k in (1, 3, 5):  # 2 / (pi k)^2, each
        assert power[k] == pytest.approx(2 / (np.pi * k) ** 2, rel=0.01)
    assert power[2] < 1e-6
    assert density.sum() * step == pytest.approx(0.25, rel=0.02)


WRONG = [
    (kept, "space-time", {}, ValueError, "kind: expected one of n_stick, .*; did you mean 'space_time'?"),
    (kept, None, {}, ValueError, "kind: expected one of"),
    (bare, "time", {}, ValueError, r"'time' draws the state .* simulate\(..., t_eval="),
    (bare, "phase", {}, ValueError, "t_eval="),
    (bare, "spectrum", {"block": 0}, ValueError, "t_eval="),
    (lambda: kept().events, "phase", {}, ValueError, "t_eval="),
    (kept, "time", {"block": 0}, TypeError, "block: unknown to the kind 'time', .* did you mean 'blocks'?"),
    (kept, "space_time", {"color": "red"}, TypeError, "color: unknown .*, which takes span, width"),
    (kept, "phase", {"colour": "red"}, TypeError, "did you mean 'color'?"),
    (kept, "phase", {"block": 2}, ValueError, "block: expected an integer from 0 to 1, got 2"),
    (kept, "time", {"blocks": [0, 1.5]}, TypeError, "blocks: expected an integer, got 1.5"),
    (kept, "time", {"of": "v"}, ValueError, "of: expected 'z' or 'w', got 'v'"),
    (kept, "n_stick", {"span": (5.0, 3.0)}, ValueError, r"span: expected two times, rising, within \[0, 40\]"),
    (lambda: draw_run("chain", 2), "spectrum", {"span": (4.0, 5.0)}, ValueError, r"'spectrum' is of what varies"),
    (kept, "n_stick", {"span": 5.0}, ValueError, "span: expected two times"),
    (kept, "slip", {}, ValueError, "width: expected the length of a row, since 'slip' is a map of a grid, got none"),
    (kept, "slip", {"width": 3}, ValueError, "width: expected an integer from 1 to 2, got 3"),
    (kept, "space_time", {"width": 0}, ValueError, "width: expected an integer at least 1, got 0"),
    (lambda: at_rest(0, 1, 3), "spectrum", {"block": 0}, ValueError, "equally spaced"),
    (lambda: at_rest(0, 1), "time", {"span": (2, 3)}, ValueError, r"kept on \[0, 1\]"),
]  # fmt: skip


@pytest.mark.parametrize(("run", "kind", "options", "error", "says"), WRONG)
def test_what_cannot_be_drawn_is_refused_and_leaves_no_figure(run, kind, options, error, says):
    before = plt.get_fignums()
    with pytest.raises(error, match=says):
        run().plot(kind, **options)
    assert plt.get_fignums() == before


@pytest.mark.parametrize("kind", pictures.KINDS)
def test_every_kind_is_drawn_where_it_is_told_with_or_without_a_span(kind):
    for options in ({}, {"span": (10.0, 30.0)}):
        ax = axes()
        assert kept().plot(kind, ax, **options, **NEEDED.get(kind, {})) is ax
        assert ax.has_data()
        ax.figure.savefig("/dev/null", format="png")


def test_a_run_of_no_time_is_drawn():
    run = simulate(SYSTEM, 0.0, 0.0, 0.0, t_eval=[0.0])
    for kind in set(pictures.KINDS) - {"spectrum"}:
        run.plot(kind, axes(), **NEEDED.get(kind, {})).figure.savefig("/dev/null", format="png")
    with pytest.raises(ValueError, match="span: expected a time that passes"):
        run.plot("spectrum", axes())


def test_one_block_without_a_name_is_drawn():
    """A tick may lie above its number."""
    block = System([[1.0]], 0.0, static=1.3, belt_speed=-0.2)
    simulate(block, 0.0, "belt", 20.0).plot("space_time", axes()).figure.savefig("/dev/null", format="png")
