"""Charts: scenes that are measured in one process on one core, where an ensemble is run.

A chart is a file and a template of the same name beside it. The file holds a `ChartScene`: a schema that declares
what to measure, measures it, and gives the page its numbers. The template has the words.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field

from stickslip.pipeline.scene.scene import MINUTES
from stickslip.pipeline.scene.toml import Positive, StrictTable, as_tuple, distinct

if TYPE_CHECKING:
    import pandas as pd

    from stickslip.analysis.answer import Recipe

Value = TypeVar("Value")
#: A key that takes one value or a list of them, kept in order without duplicates.
Several = Annotated[tuple[Value, ...], BeforeValidator(as_tuple), AfterValidator(distinct)]

#: Called with a line about each part once it is measured.
Say = Callable[[str], None]


@dataclass(frozen=True)
class Shown:
    """The parts of a page: `facts` by their names in the template, and the tables and figures to keep, by name."""

    facts: dict[str, Any] = field(default_factory=dict)
    tables: dict[str, pd.DataFrame] = field(default_factory=dict)
    figures: Mapping[str, Recipe] = field(default_factory=dict)


class ChartScene(StrictTable):
    """The keys and methods of every chart; the field `chart` of a subclass accepts only the chart's name."""

    #: Distributions that the chart uses besides the usual ones: the page names their versions.
    libraries: ClassVar[tuple[str, ...]] = ()

    chart: str = Field(description="kind of the chart")
    title: str = Field(default="", description="one line for the report's head")
    about: str = Field(default="", description="what the scene is for")
    minutes: Positive | None = Field(default=None, description=MINUTES, examples=[1.0])
    seed: int = Field(default=0, ge=0, lt=2**63, description="seed of all random draws")

    @abstractmethod
    def extent(self) -> str:
        """What would be measured, in words, for a dry run."""

    @abstractmethod
    def measure(self, say: Say) -> Any:
        """Measure everything, in this process with one thread; `say` reports each part once it is done."""

    @abstractmethod
    def show(self, measured: Any) -> Shown:
        """The facts for the template, beside `scene` and `measured` themselves, and the tables and figures."""
