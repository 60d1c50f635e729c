"""Requests: a task asks another task for something, and gets one answer, wherever both of them are by then.

A request is a packet type that names the type of its answer, and of the feedback that comes before it, if any:

    @packet_type("nav.drive_to")
    class DriveTo(Request[Arrived, Driven], frozen=True):
        x_m: float
        y_m: float

`@answers(DriveTo)` decorates the method of a task that answers it. `Task.ask` asks.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar, cast, overload

import msgspec

from pancakes.errors import ClassError, LocalProtocolError, PancakesError, RefusalCode
from pancakes.packet import THREAD, Cause, type_name
from pancakes.util.class_checks import ANSWERS, check_called, takes_pending

if TYPE_CHECKING:
    from typing import Self

    import typing_extensions

    AnswerT = typing_extensions.TypeVar("AnswerT", default=Any)
    FeedbackT = typing_extensions.TypeVar("FeedbackT", default=Any)
else:
    AnswerT = TypeVar("AnswerT")
    FeedbackT = TypeVar("FeedbackT")

_S = TypeVar("_S")
_R = TypeVar("_R")
_A = TypeVar("_A")
_F = TypeVar("_F")


class RequestError(PancakesError):
    """A request got no result. A method that answers raises it to refuse; the one that asks gets it with text and code.

    Args:
        text: the reason for people.
        code: the reason for programs, see `docs/refusals.md`; `failed` if the method that answers raised another error.
    """

    def __init__(self, text: str, code: RefusalCode = "failed") -> None:
        super().__init__(text)
        self.code = code


class RequestTimeoutError(RequestError, TimeoutError):
    """No answer came in time. The request was called off; whether it had an effect is not known."""

    def __init__(self, text: str) -> None:
        super().__init__(text, "unable")


# What a task says ------------------------------------------------------------------------------------------------


class Request(msgspec.Struct, Generic[AnswerT, FeedbackT], frozen=True):
    """The base of requests: `Request[Position]` is answered by a `Position`, `Request[Arrived, Driven]` reports too.

    A class of it is decorated with `@packet_type`. Its fields, the answer and the feedback are what a packet may have:
    numbers, strings, lists, mappings, dataclasses and structures; `Request[None]` has an answer without a value.
    """

    if not TYPE_CHECKING:

        def __class_getitem__(cls, types: Any) -> Any:
            """Return the class with the types of its answer and its feedback, of which the second may be left out."""
            given = types if isinstance(types, tuple) else (types,)
            return super().__class_getitem__((*given, Any) if cls is Request and len(given) == 1 else given)

    @classmethod
    def _answered_by(cls) -> _Answering[Self, AnswerT, FeedbackT]:
        """Return what decorates a method that answers it."""
        return cast(Any, _Mark(cls))


class _RequestClass(Protocol[_R, _A, _F]):
    """A class of requests, for type checkers: they derive from it what a method takes and returns."""

    def _answered_by(self) -> _Answering[_R, _A, _F]: ...


class _Answering(Protocol[_R, _A, _F]):
    """Decorates a method that answers requests of one class, for type checkers."""

    @overload
    def __call__(
        self, method: Callable[[_S, _R, Pending[_A, _F]], Coroutine[Any, Any, _A]], /
    ) -> Callable[[_S, _R, Pending[_A, _F]], Coroutine[Any, Any, _A]]: ...

    @overload
    def __call__(
        self, method: Callable[[_S, _R, Pending[_A, _F]], None], /
    ) -> Callable[[_S, _R, Pending[_A, _F]], None]: ...

    @overload
    def __call__(
        self, method: Callable[[_S, _R], Coroutine[Any, Any, _A]], /
    ) -> Callable[[_S, _R], Coroutine[Any, Any, _A]]: ...

    @overload
    def __call__(self, method: Callable[[_S, _R], _A], /) -> Callable[[_S, _R], _A]: ...

    def __call__(self, method: Any, /) -> Any: ...


def answers(request: _RequestClass[_R, _A, _F]) -> _Answering[_R, _A, _F]:
    """Let a method of a task answer requests of a class; what it returns is the answer, what it raises the error.

    | method | answers with |
    |---|---|
    | `def where(self, request: Where) -> Position` | what it returns |
    | `async def where(self, request: Where) -> Position` | what it returns; it is cancelled if the request is |
    | `async def drive(self, request: DriveTo, pending: Pending[Arrived, Driven]) -> Arrived` | feedback too |
    | `def drive(self, request: DriveTo, pending: Pending[Arrived, Driven]) -> None` | `pending.answer`, now or later |

    Args:
        request: a class of requests.

    Raises:
        ClassError: it is none, or the method cannot be called with such a request.
    """
    if not (isinstance(request, type) and issubclass(request, Request)):
        raise ClassError(f"@answers takes a class of requests, not {request!r}: write `class Where(Request[Position])`")
    try:
        type_name(request)
    except LocalProtocolError as error:
        raise ClassError(f"@answers cannot answer this: {error}") from None
    return cast(Any, _Mark(request))


class _Mark:
    """Marks a method with the class of requests that it answers."""

    def __init__(self, request: type[Request[Any, Any]]) -> None:
        self._request = request

    def __call__(self, method: Any) -> Any:
        name, request = getattr(method, "__name__", "answer"), self._request.__name__
        given = ("self", "request", "pending") if takes_pending(method) else ("self", "request")
        wanted = f"def {name}(self, request: {request})"
        check_called(method, given, f"@answers calls it with a {request}", wanted, may_await=True)
        setattr(method, ANSWERS, self._request)
        return method


class _Table(Protocol):
    """What the open requests of a task can do; see `pancakes.supervision.requests`."""

    def answer(self, key: Cause, value: Any) -> bool: ...
    def refuse(self, key: Cause, text: str, code: RefusalCode) -> bool: ...
    def report(self, key: Cause, value: Any) -> bool: ...
    def is_open(self, key: Cause) -> bool: ...
    def is_waited_for(self, key: Cause) -> bool: ...
    def cancel(self, key: Cause) -> bool: ...


def _table() -> _Table:
    table = getattr(THREAD.turn.reader, "requests", None)
    if table is None:
        raise PancakesError("a request is answered, reported on and cancelled in a method of its task only")
    return cast(_Table, table)


@dataclass(frozen=True)
class Pending(Generic[AnswerT, FeedbackT]):
    """A request that a task has not answered yet. It may be kept in the task's state: then it moves with the task.

    All of it is used in the methods of that task.

    Attributes:
        source, seq: which packet it came in.
    """

    source: str
    seq: int

    @property
    def is_open(self) -> bool:
        """Whether an answer is still wanted: not if it was answered, cancelled, or its time is up."""
        return _table().is_open((self.source, self.seq))

    def answer(self, value: AnswerT) -> bool:
        """Answer the request; return False, and do nothing, if no answer is wanted any more.

        Raises:
            RequestError: the value does not fit the answer's type.
        """
        return _table().answer((self.source, self.seq), value)

    def refuse(self, text: str, code: RefusalCode = "failed") -> bool:
        """Answer with an error, for people and for programs; return False if no answer is wanted any more."""
        return _table().refuse((self.source, self.seq), text, code)

    def feedback(self, value: FeedbackT) -> bool:
        """Report how far it is; return False if that is not wanted any more, or found no room and is lost.

        Raises:
            RequestError: the value does not fit the feedback's type.
        """
        return _table().report((self.source, self.seq), value)


@dataclass(frozen=True)
class Asked:
    """A request that a task has made and whose answer one of its methods gets. It may be kept in the task's state.

    Attributes:
        source, seq: which packet it went in.
    """

    source: str
    seq: int

    @property
    def is_open(self) -> bool:
        """Whether the answer is still to come. In a method of the task."""
        return _table().is_waited_for((self.source, self.seq))

    def cancel(self) -> bool:
        """Call the request off: no answer comes any more. In a method of the task.

        Returns:
            False if it has been answered.
        """
        return _table().cancel((self.source, self.seq))


class Answer(Generic[AnswerT]):
    """What has become of a request, for a method that takes the answer.

    Args:
        asked: the request.
        value: the answer.
        error: why there is none; None: there is one.

    Attributes:
        asked: the same.
        error: the same.
    """

    def __init__(self, asked: Asked, value: Any = None, error: RequestError | None = None) -> None:
        self.asked = asked
        self.error = error
        self._value = value

    @property
    def ok(self) -> bool:
        """Whether there is a result."""
        return self.error is None

    def result(self) -> AnswerT:
        """Return the answer.

        Raises:
            RequestError: there is none: it was refused, failed, or did not come in time (`RequestTimeoutError`).
        """
        if self.error is not None:
            raise self.error
        return cast(AnswerT, self._value)
