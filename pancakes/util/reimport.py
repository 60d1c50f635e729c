"""Import the modules of packages again, beside those in use.

Functions and classes keep the names of their own module, so those in use go on as they are until they are replaced. The
new modules stand in `sys.modules` during the import only. After that those in use are back, until `Reimported.install`.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from types import CodeType, ModuleType
from typing import Generic, TypeVar

T = TypeVar("T")


class Reimported(Generic[T]):
    """Modules that were imported again.

    Attributes:
        modules: the new ones, by name.
        before: those in use when they were imported, by name.
        found: what the import was for.
    """

    def __init__(self, modules: Mapping[str, ModuleType], before: Mapping[str, ModuleType], found: T) -> None:
        self.modules = modules
        self.before = before
        self.found = found

    def install(self) -> None:
        """Put the new modules in the place of those in use: an import in a function gets them from now on."""
        _exchange(self.before, self.modules)


def roots_of(modules: Iterable[str]) -> frozenset[str]:
    """Return the packages that modules belong to: the outermost ones that are not only folders of several others.

    A module in no package stands for itself. A namespace package is shared by distributions, so it is no root.
    """
    roots = set()
    for module in modules:
        parts = module.split(".")
        names = [".".join(parts[: count + 1]) for count in range(len(parts))]
        loaded = (name for name in names if not _is_namespace(sys.modules.get(name)))
        roots.add(next(loaded, module))
    return frozenset(roots)


def _is_namespace(module: ModuleType | None) -> bool:
    return module is not None and hasattr(module, "__path__") and getattr(module, "__file__", None) is None


def is_below(module: str, roots: Collection[str]) -> bool:
    """Return whether a module is one of these packages, or in one."""
    return any(module == root or module.startswith(f"{root}.") for root in roots)


def reimport(
    roots: Collection[str],
    find: Callable[[Mapping[str, ModuleType]], T],
    stays: Callable[[ModuleType, ModuleType], bool] = lambda before, after: False,
) -> Reimported[T]:
    """Import modules again from their source, and leave those in use as they are.

    Compiled files are not read: one that was written in the second of the last edit cannot be told from a new one.

    Args:
        roots: the packages whose modules are imported again, as far as they are needed.
        find: imports what is needed of them; gets the modules in use. What it raises is raised.
        stays: whether a module in use stays in the place of the one that was imported again, as it has not changed.
    """
    importlib.invalidate_caches()
    before = {name: module for name, module in list(sys.modules.items()) if is_below(name, roots)}
    _exchange(before, {})
    finder = _FromSource(roots, before, stays)
    sys.meta_path.insert(0, finder)
    try:
        found = find(before)
        modules = {name: module for name, module in list(sys.modules.items()) if is_below(name, roots)}
    finally:
        sys.meta_path.remove(finder)
        now = {name: module for name, module in list(sys.modules.items()) if is_below(name, roots)}
        _exchange(now, before)
    return Reimported(modules, before, found)


def _exchange(before: Mapping[str, ModuleType], after: Mapping[str, ModuleType]) -> None:
    """Put modules in the place of others, also where their packages name them."""
    for name in before:
        sys.modules.pop(name, None)
    sys.modules.update(after)
    for name in {**before, **after}:
        package, _, child = name.rpartition(".")
        parent = sys.modules.get(package)
        if parent is None:
            continue
        if name in after:
            setattr(parent, child, after[name])
        elif vars(parent).get(child) is before[name]:
            delattr(parent, child)


class _FromSource(MetaPathFinder):
    """Finds modules as Python does, and has them compiled from their source."""

    def __init__(
        self,
        roots: Collection[str],
        before: Mapping[str, ModuleType],
        stays: Callable[[ModuleType, ModuleType], bool],
    ) -> None:
        self._roots = roots
        self._before = before
        self._stays = stays

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if not is_below(fullname, self._roots):
            return None
        for finder in sys.meta_path:
            spec = finder.find_spec(fullname, path, target) if finder is not self else None
            if spec is not None:
                if type(spec.loader) is SourceFileLoader:
                    spec.loader = _SourceLoader(spec.loader.name, spec.loader.path, self.executed)
                return spec
        return None

    def executed(self, module: ModuleType) -> None:
        """Have those that import a module get the one in use, if that has not changed. Packages are always replaced."""
        before = self._before.get(module.__name__)
        if before is not None and not hasattr(module, "__path__") and self._stays(before, module):
            sys.modules[module.__name__] = before


class _SourceLoader(SourceFileLoader):
    def __init__(self, fullname: str, path: str, executed: Callable[[ModuleType], None]) -> None:
        super().__init__(fullname, path)
        self._executed = executed

    def get_code(self, fullname: str) -> CodeType:
        path = self.get_filename(fullname)
        return self.source_to_code(self.get_data(path), path)

    def exec_module(self, module: ModuleType) -> None:
        super().exec_module(module)
        self._executed(module)


def users_of(classes: Collection[type], roots: Collection[str]) -> Iterator[tuple[str, type]]:
    """Yield the modules outside of some packages that name a class, or its module, each with one such class."""
    wanted: dict[int, type] = {id(sys.modules.get(cls.__module__)): cls for cls in classes}
    wanted.update((id(cls), cls) for cls in classes)
    for name, module in list(sys.modules.items()):
        if module is None or is_below(name, roots):
            continue
        for value in list(getattr(module, "__dict__", {}).values()):
            if id(value) not in wanted:
                continue
            if isinstance(value, ModuleType) and value.__name__.rpartition(".")[0] == name:
                continue  # a package names its own modules
            yield name, wanted[id(value)]
            break
