"""Whose code a line of a traceback is: the user's, Pancakes', a library's."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Final

import pancakes

if TYPE_CHECKING:
    from types import FrameType, TracebackType

_PANCAKES: Final = os.path.dirname(os.path.abspath(pancakes.__file__)) + os.sep
_STANDARD: Final = os.path.dirname(os.path.abspath(os.__file__)) + os.sep
_INSTALLED: Final = (f"{os.sep}site-packages{os.sep}", f"{os.sep}dist-packages{os.sep}")


class CodeLine:
    """One line of code that was being run.

    Attributes:
        package: the top-level package or module that it belongs to.
    """

    def __init__(self, frame: FrameType, line: int) -> None:
        self._code = frame.f_code
        self._line = line
        self.package = package_of(str(frame.f_globals.get("__name__", "")))

    def __str__(self) -> str:
        return f"{os.path.basename(self._code.co_filename)}:{self._line} in {self._code.co_name}"

    @property
    def standard(self) -> bool:
        """Whether it is of Python itself."""
        path = self._code.co_filename
        return path.startswith("<") or (path.startswith(_STANDARD) and not self.installed)

    @property
    def installed(self) -> bool:
        """Whether it is of a distribution that was installed."""
        return any(part in self._code.co_filename for part in _INSTALLED)

    @property
    def own(self) -> bool:
        """Whether it is of a user's own files: not of Python, Pancakes, or what was installed."""
        return not (self.standard or self.installed or self._code.co_filename.startswith(_PANCAKES))


def package_of(module: str) -> str:
    """Returns the top-level package of a module."""
    return module.partition(".")[0]


def place_of_user(traceback: TracebackType | None, cls: type | None) -> CodeLine | None:
    """Returns the innermost line of the user's code; None: there is none.

    A user's code is what lies in the user's own files and, because a plug-in may be installed, the package of the
    class that failed; where that has no line, the packages of the classes that it inherits from.

    Args:
        traceback: where an error has come by.
        cls: the class of the task, service or driver that failed; None: it is not known.
    """
    places = _places(traceback)
    package = _user_package(cls)
    inherited = {_user_package(base) for base in cls.__mro__} - {""} if cls is not None else set()
    for place in places:
        if place.own or (package and place.package == package):
            return place
    return next((place for place in places if place.package in inherited), None)


def place_of(traceback: TracebackType | None) -> CodeLine | None:
    """Returns the innermost line that is not of Python itself, else the innermost of all; None: there is none."""
    places = _places(traceback)
    return next((place for place in places if not place.standard), places[0] if places else None)


def _places(traceback: TracebackType | None) -> list[CodeLine]:
    """The lines that an error has come by, the innermost first."""
    places = []
    while traceback is not None:
        places.append(CodeLine(traceback.tb_frame, traceback.tb_lineno))
        traceback = traceback.tb_next
    return places[::-1]


def _user_package(cls: type | None) -> str:
    """The package of a class; empty where that is Pancakes, what Pancakes is made of, or Python."""
    package = package_of(cls.__module__) if cls is not None else ""
    return "" if package in ("pancakes", "pykka", "abc", "builtins", "typing") else package
