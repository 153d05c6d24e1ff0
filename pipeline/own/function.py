"""A function of a user's own: found by its name, known by a digest from then on, and called."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import types
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from stickslip.pipeline.errors import SceneError, foreign
from stickslip.pipeline.own.files import ChangedError, check_beside, content_of, digest
from stickslip.pipeline.own.modules import file_of, load, module_of, own_modules, root_of
from stickslip.sim.numerics.arguments import did_you_mean

#: Held while a function is called: the threads of a process share its table of modules.
_alone = threading.RLock()

#: Pattern of a function's name, `module:function`.
PATTERN = r"^[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*$"


class LateError(SceneError):
    """A function loads a module beside the scene only after its trial: nobody would notice if that changed."""


@dataclass(frozen=True, slots=True)
class OwnFunction:
    """A function of the user's, as it was when its scene was read."""

    key: str = field(compare=False)  #: what errors begin with: the key of the scene that names it
    name: str  #: `module:function`
    sha256: str  #: of the module's file
    at: str = field(compare=False)  #: the folder that the module lies in, or one below it; or it is installed
    #: The files in the scene's folder that it loads or reads: paths there, and the sha256 of each.
    beside: tuple[tuple[str, str], ...] = ()

    @property
    def module(self) -> str:
        """The name of its module."""
        return self.name.partition(":")[0]

    @property
    def attribute(self) -> str:
        """Its name in there."""
        return self.name.partition(":")[2]

    @property
    def root(self) -> Path:
        """The folder of what lies beside it: the scene's, or one above it, as its copy may lie deeper."""
        return root_of(self.at, self.beside)

    def look_again(self) -> None:
        """See that its module, and what lies beside it, is as it was. Nothing is loaded; raises as `module_file`."""
        module_file(self)
        check_beside(self.root, self.beside, self.key)


def resolve(name: str, folder: Path, key: str) -> OwnFunction:
    """The function `module:function` of a module beside a scene, or installed; nothing is loaded, none is `beside`.

    Raises `SceneError` if there is no such module.
    """
    module = name.partition(":")[0]
    file = file_of(module, folder)
    if file is None:
        raise SceneError(
            f"{key}: expected the module {module!r} beside the scene, in {folder.resolve()}, or installed, "
            f"found none; write it there as {module.replace('.', '/')}.py, or correct the name"
        )
    return OwnFunction(key, name, digest(content_of(file, key)), str(folder.resolve()))


def module_file(function: OwnFunction) -> Path:
    """The file of a function's module as it was: in its folder, above it, or installed.

    Raises `ChangedError` if it is another; `SceneError` if it is gone.
    """
    module, key = function.module, function.key
    folders = dict.fromkeys((Path(function.at), *Path(function.at).parents, Path()))
    files = [file for folder in folders if (file := file_of(module, folder)) is not None]
    file = next((file for file in files if digest(content_of(file, key)) == function.sha256), None)
    if file is None:
        raise (ChangedError if files else SceneError)(
            f"{key}: expected the module {module!r} as it was when the scene was read (sha256 "
            f"{function.sha256[:12]}), in {function.at} or installed, found {'another' if files else 'none'}; on a "
            f"cluster, let the workers have it there; if it was changed, run the scene into another directory"
        )
    return file


def use(function: OwnFunction, work: Callable[[Callable[..., Any]], Any], is_trial: bool = False) -> Any:
    """What some work with a function gives; only where code of the user's may run.

    Its module is loaded once a process, from the file on disk. What it prints goes to the standard error. Raises
    `LateError` if it loads a module beside the scene that it did not load when it was tried; `SceneError` if the
    module or the function is gone, or has changed; `Exception`: whatever the work raises; what would end the process,
    as SystemExit, as a RuntimeError that names it.
    """
    process = os.getpid()
    with _alone:
        aside = contextlib.redirect_stdout(sys.stderr)  # what it prints is no part of what a command says
        with own_modules(function.root, function.beside, is_trial) as late, np.errstate(), aside:
            try:
                result = work(_found(function))
            except Exception:
                raise
            except BaseException as error:  # it would end a worker
                if isinstance(error, KeyboardInterrupt) and threading.current_thread() is threading.main_thread():
                    raise  # it may be the user's
                raise RuntimeError(foreign(error)) from error
            finally:
                if os.getpid() != process:  # a copy, which the function has forked: it would be a worker for ever
                    os._exit(1)
        if late:
            raise LateError(
                f"{function.key}: {function.name}: expected it to load {min(late.values())} when it is tried, got "
                f"it loaded later; import it at the top of the module"
            )
    # modules stay as they were loaded; other files are read again
    check_beside(function.root, [file for file in function.beside if not module_of(file[0])], function.key)
    return result


def _found(function: OwnFunction) -> Callable[..., Any]:
    """The function, of its module as it was."""
    module, attribute = _module(replace(function, name=f"{function.module}:"), function.at), function.attribute
    target = getattr(module, attribute, None)
    if not callable(target):
        names = [name for name, value in vars(module).items() if isinstance(value, types.FunctionType)]
        hint = did_you_mean(attribute, names) or f"; it has {', '.join(names) or 'none'}"
        raise SceneError(f"{function.key}: expected a function {attribute!r} in {module.__file__}, found none{hint}")
    return target


@lru_cache(maxsize=64)
def _module(function: OwnFunction, at: str) -> types.ModuleType:
    """The module of a function; `at`, which is no part of a function's identity, is of the key of the cache."""
    file = module_file(function)
    check_beside(function.root, function.beside, function.key)
    return load(function.module, file, function.sha256, function.key)
