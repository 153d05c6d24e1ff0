"""Modules beside a scene: how they are found and loaded, and how those of several scenes are kept apart."""

from __future__ import annotations

import ast
import contextlib
import importlib.abc
import importlib.machinery
import importlib.util
import sys
import types
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path

from stickslip.pipeline.own.files import content_of, is_installed, name_beside

#: Prefix of the names under which modules of functions are loaded.
_OWN = "_own_"


def folder_with(module: str, folder: Path) -> Path:
    """Where a module of a scene lies: in a folder, above it, or where the command was given; else the folder."""
    folder = folder.resolve()
    places = dict.fromkeys((folder, *folder.parents, Path().resolve()))
    candidates = ((place, file_of(module, place)) for place in places)
    return next((place for place, file in candidates if file is not None and file.is_relative_to(place)), folder)


def file_of(module: str, folder: Path) -> Path | None:
    """The file of a module in a folder, or where Python finds it. Nothing is loaded, not even its package."""
    path = folder / module.replace(".", "/")
    local = next(
        (candidate for candidate in (path.with_suffix(".py"), path / "__init__.py") if candidate.is_file()), None
    )
    if local is not None:
        return local
    top, *below = module.split(".")
    try:
        spec = importlib.util.find_spec(top)
    except (ImportError, ValueError):  # its name is not one, or what has it was not loaded from a file
        return None
    for name in below:
        if spec is None or spec.submodule_search_locations is None:
            return None
        spec = importlib.machinery.PathFinder.find_spec(f"{spec.name}.{name}", spec.submodule_search_locations)
    return Path(spec.origin) if spec is not None and spec.has_location and spec.origin else None


def root_of(folder: str, beside: tuple[tuple[str, str], ...]) -> Path:
    """The folder of the modules beside a scene: the scene's, or one above it, as its copy may lie deeper."""
    places = (Path(folder), *Path(folder).parents)
    return next((place for place in places if all((place / name).is_file() for name, _ in beside)), Path(folder))


def module_of(file: str) -> str:
    """The name of a module's file without its ending; "" for other files."""
    endings = sorted(importlib.machinery.all_suffixes(), key=len, reverse=True)
    ending = next(filter(file.endswith, endings), None)
    return "" if ending is None else file.removesuffix(ending)


def load(module: str, file: Path, sha256: str, key: str) -> types.ModuleType:
    """A module, loaded under a name of its own, so that the file on disk is what runs."""
    loaded = types.ModuleType(f"{_OWN}{module}_{sha256[:12]}")
    loaded.__file__, loaded.__package__ = str(file), module.rpartition(".")[0]
    sys.modules[loaded.__name__] = loaded  # where a dataclass looks for its own
    exec(compile(content_of(file, key), str(file), "exec"), loaded.__dict__)
    return loaded


class _Source(importlib.machinery.SourceFileLoader):
    """Compiles the file on disk each time.

    Python would take compiled code for that of another file of the same size that was written in the same second.
    """

    def get_code(self, fullname: str) -> types.CodeType:
        return self.source_to_code(self.get_data(self.path), self.path)


class _FromSource(importlib.abc.MetaPathFinder):
    """Finds modules as Python does; those beside a scene are read by `_Source`."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        spec = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if (
            spec is not None
            and isinstance(spec.loader, importlib.machinery.SourceFileLoader)
            and name_beside(spec.loader.path, self._root) is not None
        ):
            spec.loader = _Source(fullname, spec.loader.path)
        return spec


@lru_cache(maxsize=64)
def _modules(root: Path, beside: tuple[tuple[str, str], ...]) -> dict[str, types.ModuleType]:
    """The modules beside a scene that this process has loaded for its function, by name; filled by `own_modules`."""
    return {}


@contextlib.contextmanager
def own_modules(root: Path, beside: tuple[tuple[str, str], ...], is_trial: bool = False) -> Iterator[dict[str, str]]:
    """Within: a function's imports are looked for beside its scene first.

    The modules there are the function's own: others of the same names, of another scene or the caller, are set aside.

    Yields
    ------
    dict of str to str
        Empty; after it the files of modules there that are not among `beside`, by name, which are unloaded. None in
        a trial, which finds out what is beside.
    """
    modules, finder = _modules(root, beside), _FromSource(root)
    names, loaded = _names(name for name, _ in beside), set(sys.modules)
    aside = {name: sys.modules.pop(name) for name in names & loaded}
    sys.modules.update(modules)
    sys.path.insert(0, str(root))
    sys.meta_path.insert(sys.meta_path.index(importlib.machinery.PathFinder), finder)
    late: dict[str, str] = {}
    try:
        yield late
    finally:
        sys.path.remove(str(root))
        sys.meta_path.remove(finder)
        if not is_trial:
            late |= _loaded_beside(set(sys.modules) - loaded - names, root)
        for name in late:
            sys.modules.pop(name, None)
        modules.update((name, sys.modules.pop(name)) for name in names & set(sys.modules))
        sys.modules.update(aside)


def hiding(root: Path, files: Iterable[str]) -> str:
    """The module beside a scene that hides one that is installed, or Python's, and that is imported; "" if none does.

    Which of the two an import gets depends on what a process has loaded before. `files` are read there.
    """
    loaded = set(_loaded_beside(set(sys.modules), root))
    for name in sorted(loaded.union(*(_imported(root / file) for file in files if file.endswith(".py")))):
        top = name.partition(".")[0]
        candidates = (Path(f"{top}.py"), Path(top, "__init__.py"))
        file = next((file for file in candidates if (root / file).is_file()), None)
        if file is not None and _is_elsewhere(top, root):
            return file.as_posix()
    return ""


def _imported(file: Path) -> set[str]:
    """The names of the modules that the text of a module imports."""
    names: set[str] = set()
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError):  # it was read, and not as a module
        return names
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
    return names


def _is_elsewhere(top: str, root: Path) -> bool:
    """Whether a module is Python's, or of an installed package."""
    if top in sys.stdlib_module_names:
        return True
    spec = importlib.machinery.PathFinder.find_spec(
        top, [entry for entry in sys.path if Path(entry).resolve() != root]
    )
    return spec is not None and spec.origin is not None and is_installed(Path(spec.origin).resolve())


def _loaded_beside(names: Iterable[str], root: Path) -> dict[str, str]:
    """The files of those modules that lie beside the scene, without the function's own."""
    files = {name: getattr(sys.modules.get(name), "__file__", None) for name in names if not name.startswith(_OWN)}
    return {name: file for name, file in files.items() if file and name_beside(file, root) is not None}


def _names(files: Iterable[str]) -> set[str]:
    """The names of modules by their files, and of the packages that they lie in: `a.b` and `a` of a/b.py."""
    names: set[str] = set()
    for file in files:
        path = Path(module_of(file))
        steps = path.parts[:-1] if path.name == "__init__" else path.parts
        names.update(".".join(steps[:k]) for k in range(1, len(steps) + 1))
    return names
