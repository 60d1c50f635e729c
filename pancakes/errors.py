"""All errors that Pancakes raises on purpose, and how any other error reads (`describe`).

Each message is a sentence that names what is at fault (file, key, peer, packet), because the command line prints it
as it is: a traceback in a user's terminal is a defect. For an error in a user's code, `describe` adds the innermost
line of that code: the user's own files, or the package of the class that failed.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import pancakes

if TYPE_CHECKING:
    from types import FrameType, TracebackType

    from pancakes.control import Refusal


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
    """Return the top-level package of a module."""
    return module.partition(".")[0]


def place_of_user(traceback: TracebackType | None, cls: type | None) -> CodeLine | None:
    """Return the innermost line of the user's code; None: there is none.

    A user's code is what lies in the user's own files and, because a plug-in may be installed, the package of the
    class that failed; if that has no line, the packages of the classes that it inherits from.

    Args:
        traceback: the path of an error.
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
    """Return the innermost line that is not of Python itself, else the innermost of all; None: there is none."""
    places = _places(traceback)
    return next((place for place in places if not place.standard), places[0] if places else None)


def _places(traceback: TracebackType | None) -> list[CodeLine]:
    """The lines on the path of an error, the innermost first."""
    places = []
    while traceback is not None:
        places.append(CodeLine(traceback.tb_frame, traceback.tb_lineno))
        traceback = traceback.tb_next
    return places[::-1]


def _user_package(cls: type | None) -> str:
    """The package of a class; empty if that is Pancakes, one of its libraries, or Python."""
    package = package_of(cls.__module__) if cls is not None else ""
    return "" if package in ("pancakes", "pykka", "abc", "builtins", "typing") else package


RefusalCode = Literal[
    "ambiguous",
    "busy",
    "conflict",
    "failed",
    "forbidden",
    "invalid",
    "moved",
    "not_found",
    "pending",
    "unable",
    "unsupported",
]
"""Why an agent refuses something, for programs; `docs/refusals.md` says when each of them is given."""
RETRY_S: Final = 1.0
"""If something else was under way, another try is worth it after this time, in seconds."""


class PancakesError(Exception):
    """The base of all errors that Pancakes raises on purpose.

    Attributes:
        code: the reason for programs, if a request is refused because of this error.
        retry_after_s: after how long another try may succeed, in seconds; None: not before something changes.
    """

    code: RefusalCode = "failed"
    retry_after_s: float | None = None


class Fault(NamedTuple):
    """One mistake in a configuration.

    Attributes:
        where: the file, with a line number where it is known (`agent1.toml:12`), or `--set`.
        key: the table and key, such as `[task.ScanTarget] restart`.
        problem: what is wrong, as a phrase.
        suggestion: what was probably meant, or an empty string.
    """

    where: str
    key: str
    problem: str
    suggestion: str = ""

    def __str__(self) -> str:
        hint = f", did you mean {self.suggestion!r}?" if self.suggestion else ""
        return f"{self.where}: {self.key}: {self.problem}{hint}"


class ConfigError(PancakesError):
    """A configuration cannot be used. Carries all of its faults at once."""

    code = "invalid"

    def __init__(self, faults: Sequence[Fault]) -> None:
        self.faults = tuple(faults)
        super().__init__("\n".join(str(fault) for fault in self.faults))


class PluginError(PancakesError):
    """An entry point is missing or fails to load. The message names the distribution."""


class MissingExtraError(PancakesError):
    """What an extra brings is not installed. The message says what to install. A task or service that fails with it is
    given up at once, as each further try would fail too."""


class ClassError(PancakesError, TypeError):
    """A task, service or driver is written in a way that cannot work. The message has the file and line of each fault,
    and what to write instead. Raised when the class is made."""


class WireError(PancakesError):
    """Bytes or packets break the wire protocol."""


class LocalProtocolError(WireError):
    """We were about to send what the protocol forbids (a body too large, an unknown type of value)."""


class RemoteProtocolError(WireError):
    """The peer sent what the protocol forbids. Its link is closed; nothing else is touched."""


class UnknownChannelError(PancakesError):
    """A packet was published to a channel that the information stream does not have."""

    code = "not_found"


class MailboxFullError(PancakesError):
    """A `reliable` subscriber has no room: no subscriber got the packet, the publisher may try again."""

    code = "busy"
    retry_after_s = RETRY_S


class NoPermitError(PancakesError):
    """A guarded task may not act now: its guardians do not answer, and may have given it to another agent."""

    code = "busy"
    retry_after_s = RETRY_S


class ControlRefusedError(PancakesError):
    """A control packet was understood and refused. The message is the reason for people.

    Args:
        text: the message.
        code: the reason for programs.
        retry_after_s: after how long another try may succeed, in seconds; None: not before something changes.
    """

    def __init__(self, text: str, code: RefusalCode = "conflict", retry_after_s: float | None = None) -> None:
        super().__init__(text)
        self.code = code
        self.retry_after_s = RETRY_S if code == "busy" and retry_after_s is None else retry_after_s

    @classmethod
    def of(cls, refusal: Refusal | None) -> ControlRefusedError:
        """Return the error for what an agent has answered."""
        if refusal is None:
            return cls("it was refused without a reason", "failed")
        return cls(refusal.text, refusal.code, refusal.retry_after_s)


class UnreachableError(PancakesError):
    """An agent that was asked for something did not answer."""

    code = "unable"


class NoAnswerError(UnreachableError):
    """An agent was asked for something, and whether it does it is not known."""


class NoPacketError(PancakesError, TimeoutError):
    """Nothing was published in time on a channel that a program listens to."""


class MigrationError(PancakesError):
    """A task could not migrate. It goes on at its source."""

    code = "unable"


class NoCandidateError(MigrationError):
    """No neighbour can take the task. The message has each neighbour's reason."""


class PeerLostError(MigrationError):
    """The peer went away before the migration was decided."""


EXTRAS: Final = {
    "cryptography": "keys",
    "foxglove": "foxglove",
    "gymnasium": "gym",
    "mcap": "record",
    "opentelemetry": "otel",
    "matplotlib": "demo",
    "websockets": "web",
    "prometheus_client": "metrics",
    "py_trees": "trees",
    "zeroconf": "mdns",
}
"""What is not installed with the core, by its module, and the extra that brings it."""


def missing_extra(error: Exception) -> str:
    """Return the module of an extra that an import did not find; empty: there is none."""
    module = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    return module if module in EXTRAS else ""


@contextmanager
def needing_extra(what: str) -> Iterator[None]:
    """Turn a failed import of an extra's module in its block into a sentence.

    Args:
        what: what does not work without it, as the beginning of the sentence.

    Raises:
        MissingExtraError: an extra is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        missing = missing_extra(error)
        if not missing:
            raise
        raise MissingExtraError(f"{what} without {missing}: pip install 'pancakes-agents[{EXTRAS[missing]}]'") from None


LONGEST_TEXT: Final = 500
"""Most characters of an error's text in one line."""
LONGEST_SENTENCE: Final = 4000
"""And a sentence of Pancakes' own, which may name many mistakes at once."""
LONGEST_CHAIN: Final = 5
"""At most this many errors of a chain are named."""
LONGEST_TRACEBACK: Final = 8000
"""A traceback that is longer, in characters, is cut in its middle: it travels with a line of the log."""
LINES_OF_TRACEBACK: Final = 60


def describe(error: BaseException, cls: type | None = None) -> str:
    """Return an error and what led to it in one line, with the innermost line of the user's code.

    For example `ValueError: bad colour (from KeyError: 'x') at blink.py:12 in on_tick`. An error of Pancakes' own is a
    sentence already, and needs neither its type nor what led to it.

    Args:
        error: the error.
        cls: the class of the task, service or driver that failed; None: it is not known.
    """
    chain = list(chain_of(error))
    sentence = isinstance(error, PancakesError)
    found = (place_of_user(it.__traceback__, cls) for it in chain)
    place = next((place for place in found if place is not None), None)
    if place is None and not sentence:
        place = place_of(error.__traceback__)
    if sentence:
        text = _text(error, LONGEST_SENTENCE) or type(error).__name__
    else:
        led = [f"from {_said(it)}" for it in chain[1:LONGEST_CHAIN]] + ["..."] * (len(chain) > LONGEST_CHAIN)
        text = _said(error) + (f" ({', '.join(led)})" if led else "")
    return text if place is None else f"{text} at {place}"


def traceback_of(error: BaseException) -> str:
    """Return the whole traceback of an error, as Python shows it, so far as it fits `LONGEST_TRACEBACK`."""
    from traceback import TracebackException  # only now: few agents ever need it

    shown = TracebackException(type(error), error, error.__traceback__, limit=-LINES_OF_TRACEBACK)
    text = "".join(shown.format()).rstrip("\n")
    if len(text) <= LONGEST_TRACEBACK:
        return text
    head, tail = LONGEST_TRACEBACK // 4, LONGEST_TRACEBACK * 3 // 4 - 100
    left_out = len(text) - head - tail
    return f"{text[:head]}\n... {left_out:,} characters were left out ...\n{text[-tail:]}"


def chain_of(error: BaseException) -> Iterator[BaseException]:
    """Yield an error, the one that led to it, and so on, each once."""
    seen: set[int] = set()
    following: BaseException | None = error
    while following is not None and id(following) not in seen:
        seen.add(id(following))
        yield following
        context = None if following.__suppress_context__ else following.__context__
        following = following.__cause__ or context


def _said(error: BaseException) -> str:
    text = _text(error, LONGEST_TEXT)
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _text(error: BaseException, longest: int) -> str:
    try:
        text = " ".join(str(error).split())
    except Exception:  # the author of an error may have written anything
        return "(its text cannot be shown)"
    return text if len(text) <= longest else text[: longest - 1] + "…"
