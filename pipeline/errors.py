"""The errors of the pipeline. Loads nothing, so that catching an error does not load what raises it."""

from __future__ import annotations

import errno
import shlex

#: What to do about an error of the system at a path, by its number.
_REMEDIES: dict[int | None, str] = {
    errno.ENOENT: "the folder does not exist: create it or choose another",
    errno.ENOTDIR: "what it has for a folder is none: correct the path",
    errno.EISDIR: "a directory is there: choose another name",
    errno.EEXIST: "something else is there: choose another name",
    errno.ELOOP: "links on its path lead in a circle: remove one, or correct the path",
    errno.ENAMETOOLONG: "its name or path is too long: shorten it",
    errno.EACCES: "change its permissions, or choose another place",
    errno.EPERM: "change its permissions, or choose another place",
    errno.EROFS: "what is mounted there can only be read: choose another place",
    errno.ENOSPC: "make room or choose another place",
    errno.EDQUOT: "make room within your quota, or choose another place",
    errno.EFBIG: "it is larger than such a file can be: check what it is",
    errno.EMFILE: "raise `ulimit -n`",
    errno.ENFILE: "close other programs: all files of the system are in use",
}


def remedy(error: Exception) -> str:
    """What to do about an error of the system at a path."""
    return _REMEDIES.get(getattr(error, "errno", None), "check the path and its disk, or choose another place")


def printable(text: str) -> str:
    """Words of a dataset for a terminal, which obeys control characters: those are written as Python writes them."""
    if text.isprintable():  # as most are
        return text
    return "".join(c if c.isprintable() or c in "\n " else ascii(c)[1:-1] for c in text)


def foreign(error: BaseException, width: int = 300) -> str:
    """An error of code that is not ours, in one line of at most `width` characters for terminals and tables."""
    try:
        words = str(error)
    except BaseException as another:  # noqa: BLE001  its own words are foreign code too
        words = f"its message cannot be had ({type(another).__name__})"
    return shortened(f"{type(error).__name__}: {words}".strip().removesuffix(":"), width)


def shortened(text: str, width: int) -> str:
    """A text, of which a part may be foreign, in one line of at most `width` characters."""
    line = printable(" ".join(text.split()))
    return line if len(line) <= width else f"{line[: width - 3]}..."


def command(*words: str) -> str:
    """A command of ours as a shell takes it: names with spaces are quoted, and control characters are written out."""
    return " ".join(shlex.quote(word) if word.isprintable() else _escaped(word) for word in ("stickslip", *words))


def _escaped(word: str) -> str:
    text = word.replace("\\", "\\\\").replace("'", "\\'")
    return "$'" + "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text) + "'"


class SceneError(ValueError):
    """The scene cannot be used. The message has one line a problem: file, key, expected, got, remedy."""


class QueryError(ValueError):
    """The question cannot be answered. The message says what was expected and what came."""


class StoreError(RuntimeError):
    """The dataset cannot be written or read. The message says which file, why, and what to do."""


class ScheduleError(RuntimeError):
    """The run could not be done to its end. What is committed stays; the message says what to do."""


class AddressError(ScheduleError):
    """No scheduler answers at the address that was given; nothing was done."""
