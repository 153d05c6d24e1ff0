"""Pictures of a run on matplotlib axes: `KINDS` names them, and `plot` draws one.

matplotlib is loaded when something is drawn.
"""

from __future__ import annotations

import inspect
import io
from base64 import b64encode
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.numerics.arguments import Floats, apart, did_you_mean, floats, integer
from stickslip.sim.numerics.session import numpy_defaults
from stickslip.sim.runs.blocks import numbered

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes
    from matplotlib.lines import Line2D

    from stickslip.sim.runs.run import Samples
    from stickslip.sim.runs.series import EventSeries

# Okabe and Ito's palette: distinguishable with every common form of colour blindness, and in grey.
BLUE, ORANGE, GREEN, PURPLE, GREY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#666666"
CYCLE = (BLUE, ORANGE, GREEN, PURPLE, "#E69F00", "#56B4E9")

#: Mode -> what the block does, and its colour: what slips stands out.
_MODES = {0: ("sticks", "#E3E3E3"), 1: ("slips right", BLUE), -1: ("slips left", ORANGE)}

#: More intervals than this are drawn as an image of so many columns and at most so many rows.
_VECTORS, _COLUMNS, _ROWS = 4000, 1500, 750

#: Slips are drawn at least this part of the axis wide, and in an image more strongly than they are long, as far as
#: they then take no more than this share of the picture. What sums leave of a share of nothing is below the last.
_SEEN, _BUSY, _NONE = 600, 0.2, 1e-10

#: Blocks whose time series are drawn if none are named: lines of more cross each other too often to be told apart.
_FIRST = 3

#: A map of at most so many blocks a side has the numbers in its cells.
_NUMBERED = 16

#: So many blocks with names have all of them at an axis.
_NAMED = 24

#: At most so many rows of a grid are numbered, and times named, which may be long.
_TICKS, _TIMES = 12, 5

#: Means of n_stick over so many equal times make its spectrum; the spectrum averages windows of a quarter of the run.
_MEANS, _WINDOW = 8192, 4


def _time(unit: str) -> str:
    """The words of an axis of time."""
    return f"time t ({unit or 'dimensionless'})"


@contextmanager
def by_defaults(style: Mapping[str, Any] = MappingProxyType({})) -> Iterator[None]:
    """A context in which matplotlib draws by its own defaults and a style alone, and NumPy has its own rules.

    Whatever a file `matplotlibrc` or the session has set is left out, but for the backend, and restored at the end. A
    notebook's backend, which the first figure loads, makes matplotlib interactive, and later figures need that.
    """
    import matplotlib as mpl
    from matplotlib import style as styles

    with numpy_defaults(), styles.context(["default", dict(style)]):
        try:
            yield
        finally:
            is_interactive = mpl.is_interactive()
    mpl.interactive(is_interactive)


@numpy_defaults()
def plot(
    events: EventSeries, samples: Samples | None, kind: str, ax: Axes | None, options: Mapping[str, Any]
) -> Axes:
    """Draw one of `KINDS` on the axes given, or on a new pyplot figure, which a notebook shows; returns the axes.

    Axes that are given have the style of whoever made them; a new figure has matplotlib's own.

    Raises `ValueError` if the kind is unknown, needs samples and there are none, or an option has no such value;
    `TypeError` if an option is unknown to the kind, or of the wrong type.
    """
    if kind not in tuple(KINDS):
        raise ValueError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}{did_you_mean(kind, KINDS)}")
    draw = KINDS[kind]
    _check_names(draw, kind, options)
    if ax is not None:
        return draw(ax, events, samples, **options)
    import matplotlib.pyplot as plt

    with by_defaults():
        figure, ax = plt.subplots(layout="constrained")
        try:
            return draw(ax, events, samples, **options)
        except BaseException:
            plt.close(figure)  # else a notebook would show it, empty
            raise


def n_stick(
    ax: Axes, events: EventSeries, _: Samples | None, *, span: Sequence[float] | None = None, **style: Any
) -> Axes:
    """n_stick(t) as steps; `style` goes to `Axes.step`."""
    return steps(ax, *events.change_points(), events.t_end, _span(events, span), events.unit, **style)


def steps(
    ax: Axes,
    t: Floats,
    count: NDArray[np.int32],
    t_end: float,
    span: tuple[float, float],
    unit: str = "",
    **style: Any,
) -> Axes:
    """n_stick(t) as steps between the times of `span`; `count[k]` holds on [t[k], t[k+1]), the last to t_end."""
    from matplotlib.ticker import MaxNLocator

    ax.step(np.append(t, t_end), np.append(count, count[-1]), where="post", **style)
    ax.set(xlabel=_time(unit), ylabel="$n_{stick}$", xlim=_wide(span))
    ax.set_ylim(bottom=0)
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    return ax


def space_time(
    ax: Axes,
    events: EventSeries,
    _: Samples | None = None,
    *,
    span: Sequence[float] | None = None,
    width: int | None = None,
) -> Axes:
    """One row a block, coloured by what it does: which block slips when, and which way."""
    from matplotlib.patches import Patch
    from matplotlib.ticker import MaxNLocator, ScalarFormatter

    since, until = _span(events, span)
    stays = _Stays(events, since, until)
    modes = [mode for mode in _MODES if (stays.mode == mode).any()]
    if len(stays.mode) > _VECTORS and since < until:
        image, per = stays.image()
        top = image.shape[0] * per - 0.5
        ax.imshow(image, extent=(since, until, -0.5, top), origin="lower", aspect="auto")
    else:
        stays.rectangles(ax, modes)
    ax.set(xlabel=_time(events.unit), ylabel="block", xlim=_wide((since, until)), ylim=(-0.5, events.n - 0.5))
    if type(ax.xaxis.get_major_formatter()) is ScalarFormatter:  # not that of whoever gave the axes
        ax.xaxis.set_major_locator(MaxNLocator(_TIMES))
        ax.ticklabel_format(axis="x", useOffset=False)
    names = events.names or range(events.n)
    ax.yaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    ax.yaxis.set_major_formatter(lambda block, _: str(names[round(block)]) if 0 <= round(block) < events.n else "")
    if events.names and events.n <= _NAMED:
        ax.set_yticks(range(events.n), events.names)
    if width is not None:
        _rows(ax, events.n, integer("width", width, 1, None))
    return _explain(ax, [Patch(color=_MODES[mode][1], label=_MODES[mode][0]) for mode in modes])


def _rows(ax: Axes, n: int, width: int) -> None:
    """Set the rows of a grid apart, and number them in the place of the blocks."""
    firsts = range(0, n, width)
    for start in firsts[1:]:
        ax.axhline(start - 0.5, color="white", linewidth=0.8)
    spacing = -(-len(firsts) // _TICKS)
    ax.set_yticks(
        [start + (width - 1) / 2 for start in firsts[::spacing]], [*map(str, range(len(firsts))[::spacing])]
    )
    ax.set_ylabel(f"row of the grid, {width} blocks each")


def slip(
    ax: Axes,
    events: EventSeries,
    _: Samples | None = None,
    *,
    span: Sequence[float] | None = None,
    width: int | None = None,
) -> Axes:
    """How often each block of a grid began to slip, as a map with a number in each cell; crosses: never."""
    from matplotlib.ticker import MaxNLocator

    if width is None:
        raise ValueError(
            "width: expected the length of a row, since 'slip' is a map of a grid, got none; pass e.g. width=12, or"
            " draw 'space_time', which is of any blocks"
        )
    width, (since, until) = integer("width", width, 1, events.n), _span(events, span)
    inside = events.is_exit & (events.t >= since) & (events.t <= until)
    count = np.bincount(events.block[inside], minlength=events.n)
    cells = np.full((-(-events.n // width), width), np.nan)
    cells.flat[: events.n] = count
    image = ax.imshow(cells, origin="lower", cmap="Blues", vmin=0, vmax=max(int(count.max()), 1))
    is_small = width <= _NUMBERED and len(cells) <= _NUMBERED
    for block, n in enumerate(count.tolist()):
        row, column = divmod(block, width)
        if n == 0:
            ax.plot(column, row, "x", color="black", markersize=4)
        elif is_small:
            dark = n > 0.6 * count.max()
            ax.text(column, row, str(n), ha="center", va="center", fontsize=6, color="white" if dark else "black")
    ax.figure.colorbar(image, ax=ax, label=f"slips from t = {since:g} to {until:g}")
    ax.set(xlabel="place in the row", ylabel="row of the grid")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(integer=True))
    return ax


def time(
    ax: Axes,
    events: EventSeries,
    samples: Samples | None,
    *,
    blocks: int | str | Sequence[int | str] | None = None,
    of: str = "z",
    span: Sequence[float] | None = None,
    **style: Any,
) -> Axes:
    """Displacements z or velocities w of some blocks against time, with a broad line where a block sticks."""
    state = _state("time", samples)
    if of not in ("z", "w"):
        raise ValueError(f"of: expected 'z' or 'w', got {of!r}")
    since, until = _span(events, span)
    chosen = range(min(events.n, _FIRST)) if blocks is None else np.atleast_1d(np.asarray(blocks, dtype=object))
    handles = []
    for k, block in enumerate(_block("blocks", entry, events) for entry in chosen):
        look = {"color": CYCLE[k % len(CYCLE)], "label": _called(block, events)} | style
        t, sticks = _with_ends(state.t, events, block, since, until)
        value = np.interp(t, state.t, (state.z if of == "z" else state.w)[:, block])
        handles += ax.plot(t, value, **look)
        ax.plot(t, np.where(sticks, value, np.nan), **_broad(handles[-1]))
    name = {"z": "displacement z", "w": "velocity w"}[of]
    ax.set(xlabel=_time(events.unit), ylabel=name, xlim=_wide((since, until)))
    return _explain(ax, [*handles, _sticks(GREY)])


def phase(
    ax: Axes,
    events: EventSeries,
    samples: Samples | None,
    *,
    block: int | str = 0,
    span: Sequence[float] | None = None,
    **style: Any,
) -> Axes:
    """Velocity w of a block against its displacement z, with a broad line where it sticks and a dot at the start."""
    state, block = _state("phase", samples), _block("block", block, events)
    t, sticks = _with_ends(state.t, events, block, *_span(events, span))
    z, w = (np.interp(t, state.t, value[:, block]) for value in (state.z, state.w))
    look: dict[str, Any] = {"color": BLUE, "linewidth": 1.0} | style
    (line,) = ax.plot(z, w, **look)
    ax.plot(*(np.where(sticks, value, np.nan) for value in (z, w)), **_broad(line, ORANGE))
    (start,) = ax.plot(z[:1], w[:1], "o", color="black", markersize=4, label=f"t = {t[0]:g}")
    called = _called(block, events)
    ax.set(xlabel=f"displacement z of {called}", ylabel=f"velocity w of {called}")
    return _explain(ax, [_sticks(ORANGE), start])


def spectrum(
    ax: Axes,
    events: EventSeries,
    samples: Samples | None,
    *,
    block: int | str | None = None,
    span: Sequence[float] | None = None,
    **style: Any,
) -> Axes:
    """Power spectral density of n_stick, or of a block's velocity, against frequency in cycles a unit of time.

    By Welch (1967): windows of a quarter of the time, tapered by Hann's and overlapping by half, are averaged. Its
    integral is the variance. Of n_stick are taken its means over equal times, exact from the events.
    """
    from scipy.signal import welch

    since, until = _span(events, span)
    if block is None:
        step, value = (until - since) / _MEANS, _means(events, since, until)
        name = "$n_{stick}$"
    else:
        state, block = _state("spectrum", samples), _block("block", block, events)
        inside = (state.t >= since) & (state.t <= until)
        step, value = _every(state.t[inside]), state.w[inside, block]
        name = f"w of {_called(block, events)}"
    if np.ptp(value) <= 1e-12 * np.abs(value).max():
        raise ValueError(f"kind: 'spectrum' is of what varies, and {name} does not on [{since:g}, {until:g}]")
    frequency, density = welch(value, 1.0 / step, nperseg=len(value) // _WINDOW)
    ax.loglog(frequency[1:-1], density[1:-1], **({"color": BLUE, "linewidth": 1.0} | style))
    ax.set(xlabel=f"frequency (cycles per {events.unit or 'unit of time'})", ylabel=f"power density of {name}")
    return ax


#: All there are, by name. A line here makes one known to `Run.plot`, `EventSeries.plot` and the command.
KINDS: dict[str, Callable[..., Axes]] = {
    "n_stick": n_stick,
    "space_time": space_time,
    "slip": slip,
    "time": time,
    "phase": phase,
    "spectrum": spectrum,
}


def html(events: EventSeries) -> str:
    """n_stick(t) above the space-time diagram, as an HTML image."""
    from matplotlib.figure import Figure

    stream = io.BytesIO()
    with by_defaults():
        figure = Figure(figsize=(8.0, 4.5), layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True)
        n_stick(above, events, None)
        space_time(below, events)
        above.set_xlabel("")
        figure.savefig(stream, format="png", dpi=100)
    return f'<img alt="n_stick and modes" src="data:image/png;base64,{b64encode(stream.getvalue()).decode()}"/>'


class _Stays:
    """Intervals of a block in one mode between two times, block by block: `block`, `mode`, `start`, `stop`."""

    def __init__(self, events: EventSeries, since: float, until: float) -> None:
        block = np.concatenate((np.arange(events.n), events.block))
        mode = np.concatenate((events.initial_mode, events.mode))
        start = np.concatenate((np.full(events.n, events.t_start), events.t))
        order = np.argsort(block, kind="stable")
        block, mode, start = block[order], mode[order], start[order]
        stop = np.append(start[1:], events.t_end)
        stop[np.append(block[1:] != block[:-1], True)] = events.t_end
        start, stop = np.maximum(start, since), np.minimum(stop, until)
        inside = (start < stop) | ((start == stop) & (since == until))
        self.block, self.mode, self.start, self.stop = block[inside], mode[inside], start[inside], stop[inside]
        self.n, self.since, self.until = events.n, since, until

    def rectangles(self, ax: Axes, modes: Iterable[int]) -> None:
        """A rectangle each, those of one mode in one patch, which is a third of the bytes of one patch each."""
        from matplotlib.patches import PathPatch
        from matplotlib.path import Path

        n_slips = int(np.count_nonzero(self.mode))
        width = (self.until - self.since) * min(1.0 / _SEEN, _BUSY * self.n / max(n_slips, 1))
        for value in modes:
            is_mode = self.mode == value
            begin, right, low = self.start[is_mode], self.stop[is_mode], self.block[is_mode] - 0.5
            if value:
                right = np.clip(right, begin + width, self.until)  # over the stick that follows, drawn before
            corners = np.stack([begin, low, right, low, right, low + 1, begin, low + 1], axis=-1).reshape(-1, 4, 2)
            label, colour = _MODES[value]
            path = Path.make_compound_path_from_polys(corners)
            ax.add_patch(PathPatch(path, facecolor=colour, linewidth=0, label=label))

    def image(self) -> tuple[NDArray[np.float64], int]:
        """Colours, shape (rows, columns, 3), and how many blocks are one row.

        A pixel has the mean colour of its time and blocks. Where blocks seldom slip it has more of the colour of a
        slip than that, so that slips too short to be seen are, see `_tone`.
        """
        from matplotlib.colors import to_rgb

        per = -(-self.n // _ROWS)
        blocks = np.bincount(np.arange(self.n) // per)
        colours = {mode: np.array(to_rgb(colour)) for mode, (_, colour) in _MODES.items()}
        image = np.broadcast_to(colours[0], (len(blocks), _COLUMNS, 3)).copy()
        shares = {mode: self._share(mode, len(blocks), per) / blocks[:, None] for mode in (1, -1)}
        either = shares[1] + shares[-1]
        tone = _tone(either)
        for mode, share in shares.items():
            # those that a tone has spread to have the colour of the last slip before
            ratio = np.divide(share, either, out=np.zeros_like(share), where=either > _NONE)
            image += (tone * _carried(ratio, either))[..., None] * (colours[mode] - colours[0])
        return np.clip(image, 0.0, 1.0), per

    def _share(self, mode: int, rows: int, per: int) -> Floats:
        """The sum over the blocks of a row of the share of a column's time that each spends in a mode."""
        is_mode = self.mode == mode
        change = np.zeros(rows * (_COLUMNS + 2))
        for sign, t in ((1.0, self.start[is_mode]), (-1.0, self.stop[is_mode])):
            x = (t - self.since) / (self.until - self.since) * _COLUMNS
            columns = np.minimum(
                x.astype(np.int64), _COLUMNS
            )  # a step at x fills a part of this column, later ones whole
            cells = self.block[is_mode] // per * (_COLUMNS + 2) + columns
            change += np.bincount(cells, sign * (columns + 1 - x), len(change))
            change += np.bincount(cells + 1, sign * (x - columns), len(change))
        shares: Floats = np.cumsum(change.reshape(rows, -1), axis=1)[:, :_COLUMNS]
        return shares


def _tone(share: Floats) -> Floats:
    """How much of the colour of a slip pixels have, from the share of their time and blocks that slips take.

    It is that share if slips take `_BUSY` of the picture or more; else a power of it, the same for all pixels, by
    which they do. If too few pixels have a slip for that, each that has one has the whole colour, and so have those
    after it, until it can be seen, if that is not too much either.
    """
    has = share > _NONE
    if share.mean() >= _BUSY or not has.any():
        return share
    if has.mean() <= _BUSY:
        wide = has.copy()
        for k in range(1, -(-_COLUMNS // _SEEN)):
            wide[:, k:] |= has[:, :-k]
        return np.asarray(wide if wide.mean() <= _BUSY else has, dtype=np.float64)
    low, high = 0.0, 1.0
    logs, of_all = np.log(share[has]), _BUSY * share.size
    for _ in range(30):
        power = 0.5 * (low + high)
        low, high = (power, high) if np.exp(power * logs).sum() > of_all else (low, power)
    return np.where(has, np.maximum(share, _NONE) ** high, 0.0)


def _carried(of: Floats, share: Floats) -> Floats:
    """In each row, the value at the last pixel that has a slip, up to there itself."""
    places = np.where(share > _NONE, np.arange(share.shape[1]), 0)
    return np.take_along_axis(of, np.maximum.accumulate(places, axis=1), axis=1)


def _means(events: EventSeries, since: float, until: float) -> Floats:
    """Means of n_stick over `_MEANS` equal times between two."""
    if since == until:
        raise ValueError(f"span: expected a time that passes, got none: both ends are {since:g}")
    t, count = events.change_points()
    ends = np.append(t, events.t_end)
    total = np.concatenate(([0.0], np.cumsum(count * np.diff(ends))))
    times = np.linspace(since, until, _MEANS + 1)
    means: Floats = np.diff(np.interp(times, ends, total)) / (times[1] - times[0])
    return means


def _every(t: Floats) -> float:
    """The time between samples, which has to be the same."""
    gaps = np.diff(t)
    if len(t) < 8 * _WINDOW or np.ptp(gaps) > 1e-6 * gaps.mean():
        raise ValueError(
            f"samples: expected at least {8 * _WINDOW} equally spaced times for a spectrum, got {len(t)}"
            f"{' that are not' if len(t) > 2 else ''}; sample the run at numpy.linspace(t_start, t_end, 4096) by"
            " simulate(..., t_eval=...)"
        )
    return float(gaps.mean())


def _with_ends(
    sampled: Floats, events: EventSeries, block: int, since: float, until: float
) -> tuple[Floats, NDArray[np.bool_]]:
    """Times of samples and of a block's events within a span, and whether it sticks; one more in each slip.

    So a line that is left out where the block slips ends at the event, even if no sample lies in the slip.
    """
    stays = _Stays(events, since, min(until, sampled[-1]))
    is_block = stays.block == block
    mode, start, stop = stays.mode[is_block], stays.start[is_block], stays.stop[is_block]
    ends = np.concatenate((start, stop, (start + stop)[mode != 0] / 2))
    t = np.unique(np.concatenate((sampled[(sampled >= since) & (sampled <= until)], ends)))
    t = t[t >= sampled[0]]
    if not len(t):
        raise ValueError(f"span: expected times with samples, which are kept on [{sampled[0]:g}, {sampled[-1]:g}]")
    start, stop = start[mode == 0], stop[mode == 0]
    starts, place = np.searchsorted(sampled, start), np.searchsorted(sampled, stop, side="right") - 1
    inside = place > starts  # from sample to sample: at the ends, interpolation has a part of the slip in it
    start[inside], stop[inside] = sampled[starts[inside]], sampled[place[inside]]
    stop = np.append(stop, -np.inf)
    place = np.searchsorted(start, t, side="right") - 1
    return t, t <= stop[place]  # before the first, `last` is -1, and so is the last of `stop`


def _state(kind: str, samples: Samples | None) -> Samples:
    """The samples, of which there has to be one."""
    if samples is None or not len(samples):
        raise ValueError(
            f"kind: {kind!r} draws the state at given times, and none are kept; run again with their times,"
            f" simulate(..., t_eval=numpy.linspace(t_start, t_end, 4096)), and plot that run"
        )
    return samples


def _span(events: EventSeries, span: Sequence[float] | None) -> tuple[float, float]:
    """The times to draw: all, or those from one to another."""
    if span is None:
        return events.t_start, events.t_end
    low, high = apart(events.t_start, events.t_end)
    ends = floats("span", span, f"two times, rising, within [{low}, {high}]")
    if ends.shape != (2,) or not events.t_start <= ends[0] < ends[1] <= events.t_end:
        low, high, *times = apart(events.t_start, events.t_end, *ends.flat)
        raise ValueError(f"span: expected two times, rising, within [{low}, {high}], got {', '.join(times)}")
    return float(ends[0]), float(ends[1])


def _wide(span: tuple[float, float]) -> tuple[float, float]:
    """Limits of an axis: a span that is not empty."""
    return span[0], max(span[1], float(np.nextafter(span[0], np.inf)))


def _block(name: str, block: Any, events: EventSeries) -> int:
    return numbered(name, block, events.names, events.n)


def _called(block: int, events: EventSeries) -> str:
    """What a picture calls a block."""
    return events.names[block] if events.names else f"block {block}"


def _check_names(draw: Callable[..., Axes], kind: str, options: Mapping[str, Any]) -> None:
    """Refuse what is neither an option of a kind nor, where it draws lines, a property of a line."""
    parameters = inspect.signature(draw).parameters.values()
    takes = [parameter.name for parameter in parameters if parameter.kind is parameter.KEYWORD_ONLY]
    names, tail = set(takes), ""
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        from matplotlib.artist import ArtistInspector
        from matplotlib.lines import Line2D

        properties = ArtistInspector(Line2D)
        names |= {*properties.get_setters(), *(name for aliases in properties.aliasd.values() for name in aliases)}
        tail = " and properties of a line"
    for name in options:
        if name not in names:
            remedy = did_you_mean(name, sorted(names)) or "; leave it out"
            raise TypeError(f"{name}: unknown to the kind {kind!r}, which takes {', '.join(takes)}{tail}{remedy}")


def _broad(line: Line2D, colour: str | None = None) -> dict[str, Any]:
    """The look of the same line where a block sticks."""
    return {
        "color": colour or line.get_color(),
        "linewidth": 3.5 * line.get_linewidth(),
        "alpha": 0.45,
        "solid_capstyle": "butt",
        "label": "_sticks",
    }


def _sticks(colour: str) -> Line2D:
    """Its entry in a legend."""
    from matplotlib.lines import Line2D

    return Line2D([], [], color=colour, linewidth=4.0, alpha=0.45, solid_capstyle="butt", label="sticks")


def _explain(ax: Axes, handles: Sequence[Any]) -> Axes:
    """A legend in one line inside the axes, above all that is drawn: outside it would overlap, or be cut off."""
    legend = ax.legend(
        handles=handles,
        loc="upper left",
        ncols=len(handles),
        frameon=False,
        borderaxespad=0.0,
        fontsize="small",
        handlelength=1.0,
        handletextpad=0.4,
        columnspacing=1.0,
    )
    share = min(legend.get_window_extent().height / ax.get_window_extent().height, 0.5)
    low, high = ax.get_ylim()
    ax.set_ylim(low, low + (high - low) / (1.0 - share))
    return ax
