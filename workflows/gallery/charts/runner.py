"""Makes the page of a chart from its measurements."""

from __future__ import annotations

import html
import inspect
import platform
import re
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pandas as pd
from jinja2 import ChoiceLoader, Environment, FileSystemLoader, PackageLoader
from markupsafe import Markup

from stickslip.analysis import Report
from stickslip.analysis.page.layout import RULES, Page
from stickslip.analysis.page.parts import Drawn, draw
from stickslip.analysis.rows import frame_of
from stickslip.workflows.gallery.charts import ChartScene
from stickslip.workflows.gallery.charts.formats import FORMS


def versions(*libraries: str) -> dict[str, str]:
    """Versions of the libraries used, by distribution; "not installed" for a missing one."""
    numbers = {"python": platform.python_version()}
    for name in ("stickslip", "numpy", "numba", *libraries):
        try:
            numbers[name] = version(name)
        except PackageNotFoundError:
            numbers[name] = "not installed"
    return numbers


def _folder(scene: ChartScene) -> Path:
    return Path(inspect.getfile(type(scene))).parent


def _templates(folder: Path) -> Environment:
    """The templates beside a scene, those of all charts, and the page that every report extends."""
    packages = "stickslip.workflows.gallery.charts", "stickslip.analysis.page"
    templates = Environment(
        loader=ChoiceLoader([FileSystemLoader(folder), *(PackageLoader(name, ".") for name in packages)]),
        extensions=["jinja2.ext.do"],
        **RULES,
    )
    templates.filters |= FORMS
    templates.globals |= FORMS
    return templates


def report(scene: ChartScene, measured: Any) -> Report:
    """The page of a scene, made from the result of its `measure`; the headline is the page's lead."""
    parts_of_page = scene.show(measured)
    figures = {name: draw(recipe, with_pdf=True) for name, recipe in parts_of_page.figures.items()}
    templates = _templates(_folder(scene))
    templates.globals["image"] = partial(_image, figures)
    template = templates.get_template(f"{scene.chart}.html")
    page = template.render(
        parts_of_page.facts,
        page=Page(scene.title, scene.about),
        scene=scene,
        measured=measured,
        versions=versions(*scene.libraries),
    )
    return Report(page, parts_of_page.tables, [scene.title, *_headline(page)], figures)


def _headline(page: str) -> list[str]:
    """The items of the page's answer as lines of text."""
    (answer,) = re.findall(r'<ul class="answer">(.*?)</ul>', page, flags=re.DOTALL)
    items = re.findall(r"<li>(.*?)</li>", answer, flags=re.DOTALL)
    return [" ".join(html.unescape(re.sub(r"<[^>]*>", "", item)).split()) for item in items]


def _image(figures: dict[str, Drawn], name: str, alt: str) -> Markup:
    return Markup('<img src="{}" alt="{}">').format(figures[name].panel.address, alt)


def frames(measured: Any, *names: str) -> dict[str, pd.DataFrame]:
    """The tables of fields of what was measured that are lists of dataclasses, by name."""
    hints = get_type_hints(type(measured))
    return {name: frame_of(get_args(hints[name])[0], getattr(measured, name)) for name in names}
