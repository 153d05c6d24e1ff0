"""Makes the page of a chart from its measurements."""

from __future__ import annotations

import html
import inspect
import platform
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pandas as pd
from jinja2 import ChoiceLoader, FileSystemLoader
from markupsafe import Markup

from stickslip.analysis import Report
from stickslip.analysis.page.parts import Drawn, draw
from stickslip.workflows.gallery.charts import ChartScene
from stickslip.workflows.gallery.charts.formats import environment as page_environment
from stickslip.workflows.gallery.charts.formats import number


def versions(*libraries: str) -> dict[str, str]:
    """Versions of the libraries used, by distribution; "not installed" for a missing one."""
    found = {"python": platform.python_version()}
    for name in ("stickslip", "numpy", "numba", *libraries):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def _folder(scene: ChartScene) -> Path:
    return Path(inspect.getfile(type(scene))).parent


def report(scene: ChartScene, measured: Any) -> Report:
    """The page of a scene, made from the result of its `measure`; the headline is the page's lead."""
    shown = scene.show(measured)
    environment = page_environment("stickslip.workflows.gallery.charts")
    assert environment.loader is not None
    environment.loader = ChoiceLoader([FileSystemLoader(_folder(scene)), environment.loader])
    figures = {name: draw(recipe, with_pdf=True) for name, recipe in shown.figures.items()}
    environment.filters |= FORMS
    environment.globals |= FORMS | {"image": partial(_image, figures)}
    template = environment.get_template(f"{scene.chart}.html")
    page = template.render(shown.facts, scene=scene, measured=measured, versions=versions(*scene.libraries))
    return Report(page, shown.tables, [scene.title, *_headline(page)], figures)


def _headline(page: str) -> list[str]:
    """The items of the page's answer as lines of text."""
    (answer,) = re.findall(r'<ul class="answer">(.*?)</ul>', page, flags=re.DOTALL)
    items = re.findall(r"<li>(.*?)</li>", answer, flags=re.DOTALL)
    return [" ".join(html.unescape(re.sub(r"<[^>]*>", "", item)).split()) for item in items]


def _image(figures: dict[str, Drawn], name: str, alt: str) -> Markup:
    return Markup('<img src="{}" alt="{}">').format(figures[name].panel.address, alt)


def frame(rows: Sequence[Any], of: type) -> pd.DataFrame:
    """Dataclasses as the rows of a table; whole numbers stay whole where some are null."""
    hints = get_type_hints(of)
    whole = {name: "Int64" for name, hint in hints.items() if hint == int | None}
    return pd.DataFrame(map(asdict, rows), columns=list(hints)).astype(whole)


# ---------------------------------------------------------------------------------------------- forms of numbers


def count(value: float, digits: int = 2) -> str:
    """To so many digits, thousands marked; a small number to two."""
    return f"{float(f'{value:.{digits}g}'):,.0f}" if value >= 10 ** (digits - 1) else f"{value:.2g}"


def power(value: float, digits: int | None = None) -> str:
    """As 3e-4; `digits` after the point at most."""
    return np.format_float_scientific(value, precision=digits, trim="-", exp_digits=1)


def seconds(value: float) -> str:
    for unit, name in ((1.0, "s"), (1e-3, "ms")):
        if value >= unit:
            return f"{value / unit:.3g} {name}"
    return f"{value / 1e-6:.3g} µs"


def span(values: Iterable[float], form: str = "%.3g") -> str:
    """The least and the most of some numbers, once if they look alike."""
    some = sorted(values)
    if not some:
        return "none"
    low, high = form % some[0], form % some[-1]
    return low if low == high else f"{low} to {high}"


#: What templates have, as filters and as functions.
FORMS: dict[str, Callable[..., Any]] = {"count3": partial(count, digits=3)}
for _form in (count, number, power, seconds, span):
    FORMS[_form.__name__] = _form
