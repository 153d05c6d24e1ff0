"""The style of every plot: safe for colour-blind readers, legible, and the same bytes for the same data."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import wraps
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from stickslip.analysis.pictures import BLUE as BLUE
from stickslip.analysis.pictures import CYCLE as CYCLE
from stickslip.analysis.pictures import GREEN as GREEN
from stickslip.analysis.pictures import GREY as GREY
from stickslip.analysis.pictures import ORANGE as ORANGE
from stickslip.analysis.pictures import PURPLE as PURPLE
from stickslip.analysis.pictures import by_defaults
from stickslip.analysis.stats.estimates import Estimate, with_ends

if TYPE_CHECKING:  # it loads pandas
    from stickslip.analysis.ensemble import Study

STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "legend.fontsize": 9,
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "svg.hashsalt": "stickslip",  # fixed ids: the same figure is the same bytes
}


def styled() -> AbstractContextManager[None]:
    """A context in which matplotlib draws in this style, whatever the session has set."""
    return by_defaults(STYLE)


WIDTH = 7.2  # inches: the text width of the report


def svg(figure: Figure) -> str:
    """A figure as SVG text, which depends on the figure alone: it holds no date."""
    buffer = io.StringIO()
    with styled():
        FigureCanvasSVG(figure)
        layout = figure.get_layout_engine()
        if layout is not None:  # if one is left in place, even "none", the figure is drawn twice
            layout.execute(figure)
            figure.set_layout_engine(None)
        figure.savefig(buffer, format="svg", dpi=160, metadata={"Date": None})
    return buffer.getvalue()


def pdf(figure: Figure) -> bytes:
    """A figure as PDF, without date."""
    from matplotlib.backends.backend_pdf import FigureCanvasPdf  # takes a tenth of a second to load

    buffer = io.BytesIO()
    with styled():
        FigureCanvasPdf(figure)
        figure.savefig(buffer, format="pdf", metadata={"CreationDate": None})
    return buffer.getvalue()


def png(figure: Figure) -> bytes:
    """A figure as PNG, for slides and pages that take no other."""
    buffer = io.BytesIO()
    with styled():
        FigureCanvasAgg(figure)
        figure.savefig(buffer, format="png", dpi=200, metadata={"Software": None})
    return buffer.getvalue()


#: By the ending of a file: what makes its contents of a figure.
FORMS: Mapping[str, Callable[[Figure], bytes]] = {
    ".svg": lambda figure: svg(figure).encode(),
    ".pdf": pdf,
    ".png": png,
}


def blank(height: float, width: float = WIDTH) -> Figure:
    """A figure of a size in inches, by default as wide as the page's text, that lays itself out."""
    return Figure(figsize=(width, height), layout="constrained")


def legend(axes: Iterable[Axes], columns: int, **look: Any) -> None:
    """Put one legend below a figure, for the curves of these axes, with each name once."""
    handles: dict[str, Any] = {}
    for ax in axes:
        handles |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    ax.figure.legend(handles.values(), handles, loc="outside lower center", ncols=columns, **look)


PANEL = (4.2, 3.0)  # inches: half of the page, side by side on wide screens
EXACT, SMOOTHED = "#1f4e79", "#c4561a"  # the two friction laws, as filled circles and open squares
#: Of settings: told apart in grey as well, as far as ten can be.
HUES = (EXACT, SMOOTHED, GREEN, PURPLE, "#e69f00", "#56b4e9", "#6a3d9a", "#8a8d0f", "#8c564b", "#1c1c1c")
P = ParamSpec("P")


def hues(study: Study | None, labels: Sequence[str]) -> list[str]:
    """The hues of some settings in a figure: a setting has one in all figures of a page, if there are enough."""
    groups = [] if study is None else sorted(study.groups, key=lambda group: -int(group.key["n"]))
    order: Sequence[str] = [group.label for group in groups][: len(HUES)]
    if not {*labels} <= {*order}:
        order = [*dict.fromkeys(labels)]
    return [HUES[order.index(label) % len(HUES)] for label in labels]


def panel(
    height: float = PANEL[1], width: float = PANEL[0], **axes: Any
) -> Callable[[Callable[Concatenate[Any, P], object]], Callable[P, Figure]]:
    """Decorator that makes a function that draws on axes return a figure, by default half a page wide.

    Parameters
    ----------
    height, width : float
        In inches.
    **axes
        Arguments of ``Figure.subplots``; default: the function is given one `Axes`.
    """

    def of(draw: Callable[Concatenate[Any, P], object]) -> Callable[P, Figure]:
        @wraps(draw)
        def made(*args: P.args, **kwargs: P.kwargs) -> Figure:
            with styled():
                figure = blank(height, width)
                draw(figure.subplots(**axes), *args, **kwargs)
            return figure

        return made

    return of


def bars(ax: Axes, x: ArrayLike, ends: np.ndarray, **look: Any) -> None:
    """Draw estimates with their intervals against x; `ends` as of `stats.estimates.with_ends`."""
    value, low, high = ends
    ax.errorbar(x, value, [value - low, high - value], **look)


_MOST_MARKS = 400  # of a forest: more are drawn as an image


def size_axis(ax: Axes, largest: int) -> None:
    """Make x an axis of sizes from 1 to `largest`, with ticks at whole numbers, even if there is only one."""
    ax.set_xlim(0.5, largest + 0.5)
    ax.xaxis.set_major_locator(MaxNLocator(nbins="auto", integer=True, min_n_ticks=1))


@panel()
def forest(
    ax: Axes, systems: Sequence[Estimate], pooled: Estimate, xlabel: str, null: tuple[float, str] | None = None
) -> None:
    """Estimates of systems by size, one mark each with its interval; below, the pooled one, whose interval is a band.

    Systems without a value are left out. `null` is a value to compare with, and its name: a dashed line.
    """
    ends = with_ends(systems).T
    by_size = ends[np.argsort(ends[:, 0])]  # None is NaN, which comes last and is not drawn
    value, low, high = by_size[~np.isnan(by_size[:, 0])].T
    rows, is_image = np.arange(len(value)), len(value) > _MOST_MARKS
    ax.hlines(rows, low, high, color=EXACT, alpha=0.45, linewidth=0.9, rasterized=is_image)
    ax.plot(value, rows, "o", color=EXACT, markersize=1.5 if is_image else 3, rasterized=is_image)
    below = -max(2.0, 0.08 * len(rows))
    if pooled.low is not None and pooled.high is not None:
        ax.axvspan(pooled.low, pooled.high, color=EXACT, alpha=0.15, linewidth=0)
        ax.hlines(below, pooled.low, pooled.high, color=EXACT, linewidth=2)
    if pooled.value is not None:
        ax.plot(pooled.value, below, "D", color=EXACT, markersize=5)
    if null is not None:
        ax.axvline(null[0], linestyle="--", color=GREY, linewidth=1)
        ax.annotate(null[1], (null[0], 1.01), xycoords=("data", "axes fraction"), ha="center", color=GREY)
    ax.set(xlabel=xlabel, ylim=(2 * below, len(rows)))
    ax.set_yticks([below, (len(rows) - 1) / 2], ["all", "each"])
    ax.tick_params(axis="y", length=0)
    ax.spines["left"].set_visible(False)
