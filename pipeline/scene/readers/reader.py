"""What every reader of a file gives, and the checks that readers share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, ClassVar

import numpy as np

from stickslip.pipeline.machine.memory import lack
from stickslip.pipeline.machine.processes import Child, ChildDied
from stickslip.pipeline.scene.toml import MAX_BLOCKS

#: Bytes for each entry of a dense array of at most eight bytes a number: the file's, `System`'s and a kernel's copy.
BYTES_OF_ENTRY = 24
#: The largest whole number up to which float64 has all.
_MOST_WHOLE = 2**53
#: Seconds that a child has for a file.
_LONGEST = 120.0


class Reader(ABC):
    """A file of one format: the names of what it holds, and each by its name.

    The readers of Python and NumPy raise exceptions of many kinds for damaged files; none that runs in this process
    crashes.
    """

    name: ClassVar[str]  #: the format in messages, as "an .npz"
    magic: ClassVar[bytes]  #: what its files begin with
    may_crash: ClassVar[bool] = False  #: whether it is code that a damaged file can crash, to be called in a child

    def __init__(self, content: bytes) -> None:
        self._content = content

    @property
    def names(self) -> Sequence[str]:
        """The names of its arrays; "" of one that has none."""
        return ("",)

    @abstractmethod
    def read(self, name: str) -> Any:
        """An array of real numbers, or a sparse matrix, by its name.

        Raises `ValueError` if it holds anything else.
        """

    def number(self, name: str) -> float | None:
        """A single number by its name; None if it is no such thing."""
        with suppress(ValueError):
            array = self._dense(name)
            return float(array.item()) if array.size == 1 else None
        return None

    def texts(self, name: str) -> list[str]:
        """A list of texts by its name."""
        raise ValueError(f"{name}: expected texts, which {self.name} does not hold")

    def columns(self, names: Sequence[str | int]) -> list[np.ndarray]:
        """Some arrays of one number a row, by their names; the columns of the only one if none are named."""
        for name in names:
            if name not in self.names:
                there = ", ".join(filter(None, self.names)) or "one without a name"
                raise ValueError(f"expected an array {name!r}, got {there}")
        if not names:
            return [*np.atleast_2d(self._dense(self.names[0]).T)]
        return [self._dense(str(name)).reshape(-1) for name in names]

    def _dense(self, name: str) -> np.ndarray:
        array = self.read(name)
        if not isinstance(array, np.ndarray) or array.ndim > 2:
            raise ValueError(f"{name}: expected rows of numbers, got others, of shape {array.shape}")
        return array


def check_whole(name: str, array: np.ndarray) -> None:
    """Refuse whole numbers that change where they become the numbers of a matrix."""
    if array.dtype.kind in "iu" and array.size and max(int(array.max()), -int(array.min())) > _MOST_WHOLE:
        raise ValueError(
            f"{name}: expected whole numbers up to 2^53, which float64 has, got larger ones; save floats"
        )


def fits(name: str, needed: int) -> None:
    """Refuse what takes more bytes than there are."""
    problem = lack(needed, "an array that takes")
    if problem:
        raise ValueError(f"{name}: {problem}")


def square(shape: Sequence[int]) -> int:
    """The number of blocks of a matrix of a shape, which has to be square."""
    if not isinstance(shape, list) or len(shape) != 2 or shape[0] != shape[1] or not 0 < shape[0] <= MAX_BLOCKS:
        raise ValueError(f"stiffness: expected a square matrix of at most {MAX_BLOCKS} blocks, got the shape {shape}")
    return shape[0]


def in_child(function: Callable[..., Any], *arguments: Any) -> Any:
    """What a function, named at the top of a module, gives in a process of its own.

    Raises `ValueError` with its message if it raises one, dies or takes longer than `_LONGEST`.
    """
    try:
        with Child() as child, child.within(_LONGEST):
            problem, answer = child(_tried, function, arguments)
    except ChildDied as death:
        raise ValueError(f"its reader died ({death}), as of a damaged file") from None
    if problem:
        raise ValueError(problem)
    return answer


def _tried(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[str, Any]:
    """In a child: what is wrong, or what the function gives."""
    try:
        return "", function(*arguments)
    except Exception as error:  # noqa: BLE001  readers raise a dozen kinds for damaged files
        return str(error) or type(error).__name__, None
