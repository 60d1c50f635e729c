"""The open requests of one task: those that it has made, and those that it was asked and has not answered.

`Requests` is a part of `TaskCore`, made when the task first has to do with a request. Both tables are in what the task
carries, so they move with it and outlive a failure. What becomes of a request when its task goes on with another actor:

* asked by `await`: its coroutine has ended, so it is cancelled, by the new actor;
* asked with `then`: it stays open, and the new actor's method gets the answer;
* answered by a method that had not ended: the method begins again;
* answered by a `Pending`: it stays open, and the task goes on from its state.

Packets of requests go past what waits for the task (`UrgentQueue`, `TaskCore`), because a task that awaits an answer
handles no other packet. Methods of the task's author are called as `Component.call` does: one at a time.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Final, cast, get_args, get_origin

import msgspec

from pancakes.durable.snapshot import AskedRequest, CarriedRequests, KeptAnswer, OpenRequest
from pancakes.errors import (
    LONGEST_SENTENCE,
    LocalProtocolError,
    MailboxFullError,
    NoPermitError,
    PancakesError,
    RefusalCode,
    RemoteProtocolError,
    describe,
    traceback_of,
)
from pancakes.kernel.handlers import QueuePolicy, Subscription
from pancakes.kernel.mailbox import Call, tell
from pancakes.kernel.request_packets import (
    ANSWERED,
    ASK,
    CANCEL,
    CODES,
    FEEDBACK,
    REQUESTS,
    Answered,
    Ask,
    Cancel,
    Feedback,
    error_of,
    read,
)
from pancakes.mesh.codec import encodable
from pancakes.packet import TO_TASK, Cause, Packet, body_class, task_address, type_name
from pancakes.request import Answer, Asked, Pending, Request, RequestError, RequestTimeoutError
from pancakes.settings import plain_value
from pancakes.supervision.messages import RequestDue
from pancakes.util import codecs
from pancakes.util.class_checks import is_async, takes_pending

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from pancakes.kernel.actor import ActorCore
    from pancakes.kernel.timer import OneShot

MOST_ASKED: Final = 64
"""The most requests of one task that wait for their answer."""
MOST_OPEN: Final = 64
"""The most requests that one task was asked and has not answered."""
MOST_CAME: Final = 256
"""The most feedback on one request that waits for its method or coroutine; of more the oldest is lost."""
MOST_BYTES: Final = 250_000
"""The most bytes of a request, of an answer and of each feedback, as msgpack: a packet to a task has room for them.
Also between tasks of one agent, which may be apart by the next time."""
AGAIN_S: Final = 1.0
"""An answer that finds no room is sent again after this time, in host seconds."""
TYPES: Final = (ASK, FEEDBACK, ANSWERED, CANCEL)
"""What travels, in the order in which it is looked at: feedback before the answer that follows it."""
LATE: Final = "timeout"
"""The code of an answer that the task gives itself when the time is up; it never travels."""
_QUEUE: Final = QueuePolicy(256, urgent=True)


@dataclass
class _Asked:
    """A request that the task has made.

    Attributes:
        said: as it is carried.
        deadline_s: when its time is up, in mission time.
        awaits: whether a coroutine waits for it.
        came: what has come and was not handed over.
        called: whether a call is due that hands it over to a method.
        waker: wakes the coroutine; None: it does not wait.
        timer: rings when its time is up.
    """

    said: AskedRequest
    deadline_s: float
    awaits: bool = False
    came: deque[Feedback | Answered] = field(default_factory=lambda: deque(maxlen=MOST_CAME))
    called: bool = False
    waker: asyncio.Future[None] | None = None
    timer: OneShot | None = None


@dataclass
class _Open:
    """A request that the task was asked.

    Attributes:
        said: as it is carried.
        deadline_s: when its time is up, in mission time.
        running: the coroutine that answers it; None: none runs.
        begun: whether its method was called by this actor.
        timer: rings when its time is up.
    """

    said: OpenRequest
    deadline_s: float
    running: asyncio.Task[Any] | None = None
    begun: bool = False
    timer: OneShot | None = None


class Requests:
    """The open requests of one task. All of it is called in the actor.

    Args:
        core: the inside of the task.
        methods: the names of the methods that answer, by the packet type of the request.
        changed: called when what the task carries of its requests has changed.
        carried: what its predecessor carried; None: nothing.
    """

    def __init__(
        self,
        core: ActorCore,
        methods: Mapping[str, str],
        changed: Callable[[], None],
        carried: CarriedRequests | None = None,
    ) -> None:
        self._core = core
        self._facade: Any = core.facade
        self._methods = methods
        self._changed = changed
        now_s = core.now()
        carried = carried or CarriedRequests()
        self._asked = {it.key: _Asked(it, now_s + it.left_s) for it in carried.asked}
        self._open = {it.key: _Open(it, now_s + it.left_s) for it in carried.open}
        self._goes_on = (tuple(self._asked), tuple(self._open))
        self._has_begun = False
        self._reads = False

    def subscribe(self) -> None:
        """Read the packets of requests that name this task."""
        core, self._reads = self._core, True
        for name in TYPES:
            core.kernel.stream.subscribe(core.address, core.actor_inbox, Subscription(REQUESTS, name, _QUEUE, True))

    def begin(self) -> None:
        """Go on with what the predecessor carried; the task has started."""
        self._has_begun = True
        asked, opened = self._goes_on
        self._goes_on = ((), ())
        for key in asked:
            one = self._asked.get(key)
            if one is None:  # answered or cancelled in on_start
                continue
            if not one.said.then:
                self._call_off(key)
            elif one.said.answer is not None:
                self._bring(key, one, _said(key, one.said.answer))
            else:
                self._time(key, one)
        for key in opened:
            it = self._open.get(key)
            if it is None:
                continue
            self._time(key, it)
            if it.said.answer is not None:
                self._send(key, it)
            elif it.said.cancelled:
                self._call(partial(self._tell_cancelled, key))
            elif it.said.later and self._answers_at_once(it):  # as its class was reloaded, and no `Pending` is for it
                it.said = msgspec.structs.replace(it.said, later=False)
        self.go_on()

    def go_on(self) -> None:
        """Begin what has waited for the end of a pause."""
        if not self._has_begun:
            return
        for key, it in self._open.items():
            said = it.said
            if not (it.begun or said.later or said.cancelled or said.answer is not None):
                self._call(partial(self._begin, key))

    def end(self) -> None:
        """Let no timer keep the actor, which has ended."""
        for one in self._asked.values():
            _stop(one.timer)
        for it in self._open.values():
            _stop(it.timer)

    def carried(self, exactly: bool = False) -> CarriedRequests | None:
        """Return what a successor needs; None: nothing.

        Args:
            exactly: whether it says how much time is left now. Else it says what was left when the task began, or was
                asked, so that a checkpoint differs only if something has changed.
        """
        if not self._asked and not self._open:
            return None
        now_s = self._core.now()

        def left(one: _Asked | _Open) -> Any:
            return msgspec.structs.replace(one.said, left_s=max(0.0, one.deadline_s - now_s)) if exactly else one.said

        return CarriedRequests(tuple(map(left, self._asked.values())), tuple(map(left, self._open.values())))

    def look(self) -> None:
        """Take the packets that have come since the last look."""
        if not self._reads:
            return
        queues = self._core.actor_inbox.queues[REQUESTS]
        came: list[Packet] = []
        # What follows is taken out first: then all that it follows has come, and goes before it.
        for name in reversed(TYPES):
            waiting = queues.of(name)
            came[:0] = [waiting.take() for _ in range(len(waiting))]
        for packet in came:
            self.take(packet)

    def take(self, packet: Packet) -> None:
        """Take a packet of requests. One that comes a second time has no second effect."""
        try:
            body = read(packet)
        except RemoteProtocolError as error:
            self._core.log_line("warning", str(error), "")
            return
        match body:
            case Ask():
                self._was_asked(packet, body)
            case Answered():
                self._was_answered((body.source, body.seq), body)
            case Feedback():
                self._was_told((body.source, body.seq), body)
            case Cancel():
                self._was_cancelled((body.source, body.seq))

    def due(self, message: RequestDue) -> None:
        """The time of a request is up, or its answer may be sent again."""
        key = message.key
        if message.asked:
            one = self._asked.get(key)
            if one is None or one.said.answer is not None:
                return
            self._publish(Cancel(*key), one.said.to)
            text = f"{one.said.to} has not answered {one.said.type!r} within {one.said.timeout_s:g} s"
            self._was_answered(key, Answered(*key, code=LATE, text=text))
        elif message.again:
            it = self._open.get(key)
            if it is not None and it.said.answer is not None:
                self._send(key, it)
        else:
            self._was_cancelled(key)

    # Asking ----------------------------------------------------------------------------------------------------

    def ask(
        self, to: str, request: Request[Any, Any], timeout_s: float, then: Any = None, feedback: Any = None
    ) -> Asked:
        """Make a request whose answer a method of the task gets; see `Task.ask`."""
        for method in (then, feedback) if feedback is not None else (then,):
            self._check_method(method)
        key = self._make(to, request, timeout_s, _name_of(then), _name_of(feedback))
        return Asked(*key)

    async def answer_to(
        self, to: str, request: Request[Any, Any], timeout_s: float, feedback: Callable[[Any], object] | None
    ) -> Any:
        """Make a request and wait for its answer; see `Task.ask`."""
        if not self._has_begun:
            raise PancakesError(
                f"{self._core.address} awaits an answer in on_start, and gets none before it has started: ask in a"
                " handler, or in a method that on_start gives to `self.call`"
            )
        key = self._make(to, request, timeout_s, "", "")
        one = self._asked[key]
        one.awaits = True
        answer_type, feedback_type = _types_of(type(request))
        try:
            while True:
                while not one.came:
                    one.waker = asyncio.get_running_loop().create_future()
                    await one.waker
                came = one.came.popleft()
                if isinstance(came, Answered):
                    self._asked.pop(key, None)
                    answer = _answer_of(key, one, came, answer_type)
                    return answer.result()
                if feedback is not None:
                    feedback(_converted(came.body, feedback_type, f"the feedback of {to}"))
        finally:
            # Of a task that is frozen the snapshot has this request, and its successor calls it off.
            if key in self._asked and not self._core.is_frozen:
                self._call_off(key)

    def _check_method(self, method: Any) -> None:
        facade, name = self._facade, _name_of(method)
        if getattr(method, "__self__", None) is not facade or getattr(facade, name, None) != method:
            raise PancakesError(
                f"{self._core.address} names {method!r} for an answer, which must reach the task wherever it is by"
                " then: name a method of the task, as in `then=self.answered`"
            )

    def _make(self, to: str, request: Request[Any, Any], timeout_s: float, then: str, feedback: str) -> Cause:
        core = self._core
        if not isinstance(request, Request):
            raise PancakesError(f"{core.address} asks {request!r}, which is no request: derive its class from Request")
        if not 0.0 < timeout_s < math.inf:
            raise PancakesError(f"{core.address} asks for an answer within {timeout_s!r} s: give a time above 0")
        if not _is_task(to):
            raise PancakesError(
                f"{core.address} asks {to!r}, which names no single task: write `agent/service/task` for the task that"
                " is there, or `task_address('birthplace/task')` for one that may move"
            )
        own = task_address(core.fence.task_id) if core.fence is not None else ""
        if to in (core.address, own):
            raise PancakesError(f"{core.address} asks itself, and could never answer meanwhile: call the method")
        if len(self._asked) >= MOST_ASKED:
            raise RequestError(f"{core.address} waits for {MOST_ASKED} answers already", "busy")
        ask = Ask(type_name(request), _plain(request, f"the request {type_name(request)!r}"), timeout_s, own)
        if not own:
            self.subscribe()
        packet = core.publish(REQUESTS, ask, to)
        key = (packet.source, packet.seq)
        said = AskedRequest(*key, to, ask.type, timeout_s, timeout_s, then, feedback)
        self._asked[key] = one = _Asked(said, core.now() + timeout_s)
        self._time(key, one)
        self._changed()
        return key

    def _call_off(self, key: Cause) -> bool:
        one = self._asked.pop(key, None)
        if one is None:
            return False
        _stop(one.timer)
        self._publish(Cancel(*key), one.said.to)
        self._changed()
        return True

    def _was_answered(self, key: Cause, answered: Answered) -> None:
        one = self._asked.get(key)
        if one is None or one.said.answer is not None:
            return  # it is late, or comes twice
        _stop(one.timer)
        one.said = msgspec.structs.replace(one.said, answer=_kept(answered))
        self._changed()
        self._bring(key, one, answered)

    def _was_told(self, key: Cause, told: Feedback) -> None:
        one = self._asked.get(key)
        if one is None or one.said.answer is not None or told.number <= one.said.heard:
            return
        one.said = msgspec.structs.replace(one.said, heard=told.number)
        if one.awaits or one.said.feedback:
            self._bring(key, one, told)

    def _bring(self, key: Cause, one: _Asked, came: Feedback | Answered) -> None:
        """Let the coroutine or the method that waits for it have what has come."""
        one.came.append(came)
        if not one.awaits:
            if not one.called:  # one call at a time, as any number may come while the task awaits
                one.called = True
                self._call(partial(self._hand_over, key))
        elif one.waker is not None and not one.waker.done():
            one.waker.set_result(None)
            self._core.settle_in(0.0)

    def _hand_over(self, key: Cause) -> Any:
        one = self._asked.get(key)
        if one is None:
            return None
        came = one.came.popleft()
        if isinstance(came, Feedback):
            one.called = bool(one.came)
            if one.called:
                self._call(partial(self._hand_over, key))
            return self._hand_feedback(one, came)
        del self._asked[key]
        self._changed()
        return self._method(one.said.then)(_answer_of(key, one, came, _types_of(_class_of(one.said.type))[0]))

    def _hand_feedback(self, one: _Asked, told: Feedback) -> Any:
        try:
            value = _converted(told.body, _types_of(_class_of(one.said.type))[1], f"the feedback of {one.said.to}")
        except RequestError as error:
            self._core.log_line("warning", str(error), "")
            return None
        return self._method(one.said.feedback)(value)

    def _method(self, name: str) -> Callable[[Any], Any]:
        # Another version of its class may have taken over meanwhile, which has no such method.
        return cast(Callable[[Any], Any], getattr(self._facade, name, partial(self._lose, name)))

    def _lose(self, name: str, value: Any) -> None:
        what = "an answer" if isinstance(value, Answer) else "feedback"
        address = self._core.address
        self._core.log_line("warning", f"{address} has no method {name!r} any more: {what} for it is lost", "")

    # Answering -------------------------------------------------------------------------------------------------

    def _was_asked(self, packet: Packet, ask: Ask) -> None:
        key, core = (packet.source, packet.seq), self._core
        if key in self._open:
            return
        reply_to = ask.reply_to if ask.reply_to.startswith(TO_TASK) else packet.source
        published = core.local_time(packet)
        age_s = max(0.0, core.now() - published.time_s) if published is not None else 0.0
        left_s = ask.timeout_s - age_s
        if not left_s > 0.0:
            return  # it has waited for long on its way, and no answer is wanted any more
        said = OpenRequest(*key, reply_to, ask.type, ask.body, left_s)
        it = _Open(said, core.now() + left_s)
        refusal: RequestError | None = None
        if ask.type not in self._methods:
            refusal = RequestError(f"{core.address} answers no {ask.type!r}", "unsupported")
        elif len(self._open) >= MOST_OPEN:
            refusal = RequestError(f"{core.address} has {MOST_OPEN} requests to answer already", "busy")
        else:
            try:
                _converted(ask.body, _class_of(ask.type), f"the request of {packet.source}")
            except RequestError as error:
                refusal = error
        if refusal is not None:
            self._publish(Answered(*key, None, refusal.code, str(refusal)), reply_to)
            return
        self._open[key] = it
        self._time(key, it)
        self._changed()
        self._call(partial(self._begin, key))

    def _begin(self, key: Cause) -> Any:
        """Call the method that answers. As a call of the task's own, so that nothing else of it runs."""
        it, core = self._open.get(key), self._core
        if it is None or it.begun or core.is_paused or core.is_waiting:
            return  # `go_on` calls it at the end of a pause
        name = self._methods.get(it.said.type, "")
        if not name:  # another version of its class has taken over meanwhile
            self._reply(
                key, Answered(*key, None, "unsupported", f"{core.address} answers no {it.said.type!r} any more")
            )
            return
        it.begun = True
        method, own = getattr(self._facade, name), getattr(type(self._facade), name)
        # What the method publishes has the request as its cause.
        core.in_hand = Packet(REQUESTS, ASK, key[0], core.address, core.now(), key[1], None)
        try:
            given = [_converted(it.said.body, _class_of(it.said.type), f"the request of {key[0]}")]
            if takes_pending(own):
                given.append(Pending(*key))
            if is_async(own):
                core.await_between_turns(self._run(key, it, method(*given)))
                return
            if _answers_later(own):
                it.said = msgspec.structs.replace(it.said, later=True)
            value = method(*given)
            if not _answers_later(own):
                self.answer(key, value)
        except Exception as error:
            self._failed(key, error)
        finally:
            core.in_hand = None

    def _answers_at_once(self, it: _Open) -> bool:
        name = self._methods.get(it.said.type)
        return name is not None and not _answers_later(getattr(type(self._facade), name))

    async def _run(self, key: Cause, it: _Open, answering: Coroutine[Any, Any, Any]) -> None:
        if key not in self._open:  # it was cancelled before it began
            answering.close()
            return
        it.running = running = asyncio.current_task()
        try:
            self.answer(key, await answering)
        except asyncio.CancelledError:
            if running is None or not running.cancelling():
                self._failed(key, RequestError("the method that answers has cancelled itself"))
            elif key in self._open:
                raise  # the task is stopped, or has migrated
        except Exception as error:
            self._failed(key, error)
        finally:
            it.running = None

    def _failed(self, key: Cause, error: Exception) -> None:
        core = self._core
        if isinstance(error, PancakesError):
            self.refuse(key, str(error), error.code)
            return
        text = describe(error, core.author_class)
        core.log_line("error", f"{core.address} fails to answer a request of {key[0]}: {text}", traceback_of(error))
        self.refuse(key, text, "failed")

    def _was_cancelled(self, key: Cause) -> None:
        it = self._open.get(key)
        if it is None or it.said.cancelled:
            return
        _stop(it.timer)
        self._changed()
        if it.said.later and it.said.answer is None:
            it.said = msgspec.structs.replace(it.said, cancelled=True)
            self._call(partial(self._tell_cancelled, key))
            return
        del self._open[key]
        if it.running is not None:
            it.running.cancel()
            self._core.settle_in(0.0)

    def _tell_cancelled(self, key: Cause) -> None:
        if self._open.pop(key, None) is not None:
            self._facade.on_cancel(Pending(*key))

    def _reply(self, key: Cause, answered: Answered) -> bool:
        it = self._open.get(key)
        if it is None or it.said.cancelled or it.said.answer is not None:
            return False
        it.said = msgspec.structs.replace(it.said, answer=_kept(answered))
        self._changed()
        self._send(key, it)
        return True

    def _send(self, key: Cause, it: _Open) -> None:
        """Send an answer; if it finds no room it stays, and is sent again until its time is up."""
        if it.said.answer is None:
            return
        try:
            self._core.publish(REQUESTS, _said(key, it.said.answer), it.said.reply_to)
        except (MailboxFullError, NoPermitError):
            due = RequestDue(key, asked=False, again=True)
            self._core.kernel.timer.after_host(AGAIN_S, partial(self._remind, due))
            return
        except PancakesError as error:
            self._core.log_line("warning", f"the answer to {it.said.reply_to} is lost: {error}", "")
        _stop(it.timer)
        self._open.pop(key, None)

    # What `Pending` and `Asked` ask for ------------------------------------------------------------------------

    def answer(self, key: Cause, value: Any) -> bool:
        """See `Pending.answer`."""
        it = self._open.get(key)
        if it is None:
            return False
        plain = _checked(value, _types_of(_class_of(it.said.type))[0], f"the answer to {it.said.type!r}")
        return self._reply(key, Answered(*key, plain))

    def refuse(self, key: Cause, text: str, code: RefusalCode) -> bool:
        """See `Pending.refuse`."""
        short = text if len(text) <= LONGEST_SENTENCE else f"{text[:LONGEST_SENTENCE]} ..."
        return self._reply(key, Answered(*key, None, code if code in CODES else "failed", short))

    def report(self, key: Cause, value: Any) -> bool:
        """See `Pending.feedback`."""
        if not self.is_open(key):
            return False
        it = self._open[key]
        plain = _checked(value, _types_of(_class_of(it.said.type))[1], f"the feedback on {it.said.type!r}")
        it.said = msgspec.structs.replace(it.said, told=it.said.told + 1)
        return self._publish(Feedback(*key, it.said.told, plain), it.said.reply_to)

    def is_open(self, key: Cause) -> bool:
        """See `Pending.is_open`."""
        it = self._open.get(key)
        return it is not None and not it.said.cancelled and it.said.answer is None

    def is_waited_for(self, key: Cause) -> bool:
        """See `Asked.is_open`."""
        return key in self._asked

    def cancel(self, key: Cause) -> bool:
        """See `Asked.cancel`."""
        return self._call_off(key)

    # Effects ---------------------------------------------------------------------------------------------------

    def _call(self, function: Callable[[], Any]) -> None:
        self._core.actor_inbox.put(Call(self._core, function))

    def _publish(self, body: Any, to: str) -> bool:
        """Publish what may be lost; return whether it was not."""
        try:
            self._core.publish(REQUESTS, body, to)
        except PancakesError as error:
            self._core.log_line("debug", f"{type(body).__name__} for {to} is lost: {error}", "")
            return False
        return True

    def _time(self, key: Cause, one: _Asked | _Open) -> None:
        core, due = self._core, RequestDue(key, asked=isinstance(one, _Asked))
        one.timer = core.kernel.timer.after(max(0.0, one.deadline_s - core.now()), partial(self._remind, due))

    def _remind(self, due: RequestDue) -> None:
        """In the timer\'s thread."""
        tell(self._core, due)


def _kept(answered: Answered) -> KeptAnswer:
    return KeptAnswer(answered.body, answered.code, answered.text)


def _said(key: Cause, kept: KeptAnswer) -> Answered:
    return Answered(*key, kept.body, kept.code, kept.text)


def _stop(timer: OneShot | None) -> None:
    if timer is not None:
        timer.cancel()


def _name_of(method: Any) -> str:
    return str(getattr(method, "__name__", "")) if method is not None else ""


def _types_of(request: type) -> tuple[Any, Any]:
    """Return the types of the answer and of the feedback of a class of requests."""
    for base in request.__mro__:
        for it in vars(base).get("__orig_bases__", ()):
            if get_origin(it) is Request:
                answer, feedback = get_args(it)
                return answer, feedback
    return Any, Any


def _answers_later(method: Any) -> bool:
    """Return whether a method answers by its `Pending`, and not by what it returns."""
    return takes_pending(method) and not is_async(method)


def _is_task(to: Any) -> bool:
    if not isinstance(to, str):
        return False
    parts = to.removeprefix(TO_TASK).split("/")
    return len(parts) == (2 if to.startswith(TO_TASK) else 3) and all(parts) and "*" not in to


def _class_of(name: str) -> type:
    return body_class(name) or Request


def _checked(value: Any, kind: Any, what: str) -> Any:
    """Return a value as plain values, which fit a type.

    Raises:
        RequestError: they do not, or the value cannot be sent.
    """
    plain = _plain(value, what)
    _converted(plain, kind, what)
    return plain


def _plain(value: Any, what: str) -> Any:
    """Return a value as plain values that can be sent.

    Raises:
        RequestError: there are none, or they take too many bytes.
    """
    try:
        plain = plain_value(value)
        size = len(codecs.encode(encodable(plain)))
    except (LocalProtocolError, *codecs.UNENCODABLE) as error:
        raise RequestError(f"{what} cannot be sent: {error}", "invalid") from None
    if size > MOST_BYTES:
        raise RequestError(f"{what} takes {size} bytes, and {MOST_BYTES} is the most: send it in parts", "invalid")
    return plain


def _converted(plain: Any, kind: Any, what: str) -> Any:
    try:
        return codecs.convert(plain, kind, lambda _, value: value)
    except msgspec.ValidationError as error:
        raise RequestError(f"{what} does not fit its type: {error}", "invalid") from None
    except TypeError as error:
        raise RequestError(f"{what} has a type that cannot travel: {error}", "unsupported") from None


def _answer_of(key: Cause, one: _Asked, answered: Answered, kind: Any) -> Answer[Any]:
    asked = Asked(*key)
    if answered.code == LATE:
        return Answer(asked, error=RequestTimeoutError(answered.text))
    error = error_of(answered)
    if error is not None:
        return Answer(asked, error=error)
    try:
        return Answer(asked, _converted(answered.body, kind, f"the answer of {one.said.to}"))
    except RequestError as misfit:
        return Answer(asked, error=misfit)
