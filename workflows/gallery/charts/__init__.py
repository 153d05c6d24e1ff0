"""Charts: scenes that are measured in one process on one core, where an ensemble is run.

A chart is a file and a template of its name beside it. The file holds a `ChartScene`: a schema that says what would
be measured, measures it, and hands the page its numbers. The template has the words.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
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

#: Told of each thing as it is done.
Say = Callable[[str], None]


@dataclass(frozen=True)
class Shown:
    """What a page is made of: `facts` by their names in the template, and by name the tables and figures to keep."""

    facts: dict[str, Any] = field(default_factory=dict)
    tables: dict[str, pd.DataFrame] = field(default_factory=dict)
    figures: dict[str, Recipe] = field(default_factory=dict)


class ChartScene(StrictTable):
    """The keys that every chart has, and what it does; `chart` of a subclass takes the chart's name alone."""

    #: Distributions that take part, beside those that always do: the page names their versions.
    libraries: ClassVar[tuple[str, ...]] = ()

    chart: str = Field(description="kind of the chart")
    title: str = Field(default="", description="one line for the report's head")
    about: str = Field(default="", description="what the scene is for")
    minutes: Positive | None = Field(default=None, description=MINUTES, examples=[1.0])
    seed: int = Field(default=0, ge=0, lt=2**63, description="seed of all random draws")

    @abstractmethod
    def extent(self) -> str:
        """What would be measured, for a dry run."""

    @abstractmethod
    def measure(self, say: Say) -> Any:
        """Measure all of it, in this process with one thread; `say` is told of each part as it is done."""

    @abstractmethod
    def show(self, measured: Any) -> Shown:
        """What the template is given, beside `scene` and `measured` themselves, and the tables."""
