"""An agent's session with a Zenoh router, and the thread that speaks to it.

A router that does not read makes its sessions wait for seconds. So no thread of an agent calls Zenoh but this one; what
Zenoh brings, it brings in threads of its own.
"""

from __future__ import annotations

import contextlib
import json
import queue
import random
import re
import secrets
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, Protocol

import zenoh

from pancakes.errors import PancakesError
from pancakes.util.files import check_plain
from pancakes_zenoh.link_frames import LONGEST_PHRASE, PIECE_BYTES

RETRY_S: Final = 1.0
"""So long at most until a session is tried for again where no router has answered, then twice as long ..."""
LONGEST_RETRY_S: Final = 8.0
"""... up to this, at random: hundreds of agents at once must not keep a router from answering any. A session that was
lost Zenoh opens again by itself."""
CLOSE_S: Final = 2.0
"""For the last frames, and for the router to hear that the session ends."""
ANSWER_S: Final = 3.0
"""For the routers to find the session that listens at an address."""
SAYINGS: Final = 4
"""So often it speaks to its router in that time. Agents need not speak to each other for that."""
_NOWHERE: Final = "-/0"
"""No agent listens there."""
_LARGEST_MESSAGE: Final = PIECE_BYTES + LONGEST_PHRASE

Answer = Callable[[str, str], None]
"""Takes the session that listens at an address, and why there is none, as a phrase; one of them is empty."""


class SessionUser(Protocol):
    """What hears of a session's news, in threads of Zenoh's."""

    def came(self, frame: bytes) -> None:
        """A frame for this session came."""

    def gone(self, session: str, why: str) -> None:
        """Another session has ended, or no frame gets there."""

    def there(self, session: str) -> None:
        """A session is there, for the first time or again after it was gone."""


class RouterSession:
    """One session.

    Args:
        routers: where routers are reached, such as `tcp/192.0.2.1:7447`; empty: where the file says.
        file: a configuration file of Zenoh's; empty: none.
        space: the name below which the fleet's keys are.
        user: hears of its news.
        silent_s: it has ended for the routers once it is silent for so long.

    Attributes:
        id: its id, which is drawn at random.
        fault: why it could not be opened when that was last tried, as a clause; empty: it could, or is being tried.

    Raises:
        PancakesError: the file is of no use; the sentence says why.
    """

    def __init__(self, routers: Sequence[str], file: str, space: str, user: SessionUser, silent_s: float) -> None:
        self.id = f"{secrets.randbits(127) | 1 << 127:032x}"
        self._config = session_config("client", routers, file, self.id, silent_s)
        self._where = " or ".join(routers) or f"where {file} says"
        self._root = f"pancakes/1/{space}"
        self._user = user
        self.fault = ""
        self._calls: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._tried, self._closing = threading.Event(), threading.Event()
        self._session: zenoh.Session | None = None
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._kept: list[Any] = []  # Zenoh ends what nothing refers to
        self._places: dict[str, Any] = {}
        self._thread = threading.Thread(target=self._run, name=f"zenoh-{self.id[:6]}", daemon=True)
        self._thread.start()

    # From any thread; none of them waits for a router

    def post(self, session: str, frame: bytes) -> None:
        """Sends a frame to another session, behind all that were posted before."""
        self._calls.put(lambda: self._put(session, frame))

    def forget(self, session: str) -> None:
        """Nothing more is posted to a session for now."""
        self._calls.put(lambda: self._undeclare(session))

    def ask(self, place: str, answer: Answer) -> None:
        """Asks which session listens at `HOST/PORT`; the answer comes in a thread of its own."""
        if self.fault:
            answer("", self.fault)
        else:
            self._calls.put(lambda: self._ask(place, answer))

    def stop_listening(self, place: str) -> None:
        """Says no more that this session listens at `HOST/PORT`."""
        self._calls.put(lambda: self._stop_listening(place))

    def close(self) -> None:
        """Ends it, once what was posted has gone, if that takes no longer than `CLOSE_S`."""
        self._closing.set()
        self._calls.put(None)
        self._thread.join(CLOSE_S)

    # For the thread that starts an agent, which may wait

    def is_taken(self, place: str, wait_s: float) -> bool:
        """Returns whether another session listens at `HOST/PORT`; False where no router says within `wait_s`."""
        if not self._tried.wait(wait_s) or self.fault:
            return False
        found: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.ask(place, lambda session, why: found.put(session))
        with contextlib.suppress(queue.Empty):
            return found.get(timeout=wait_s) not in ("", self.id)
        return False

    def listen(self, place: str, wait_s: float) -> None:
        """Says that this session listens at `HOST/PORT`, to all that ask, from when there is a router.

        Returns once the router knows, where it says so within `wait_s`.
        """
        self._calls.put(lambda: self._listen(place))
        if not self.fault:
            known = threading.Event()
            self.ask(_NOWHERE, lambda session, why: known.set())  # behind it, so the router has both or none
            known.wait(wait_s)

    # In its thread

    def _run(self) -> None:
        retries_s = waits_between_tries_s(secrets.SystemRandom())
        while not self._open():
            self._tried.set()
            if self._closing.wait(next(retries_s)):
                return
        self.fault = ""
        self._tried.set()
        while (call := self._calls.get()) is not None:
            with contextlib.suppress(zenoh.ZError):  # what is lost ends its link, see `routed_link`
                call()
        assert self._session is not None
        with contextlib.suppress(zenoh.ZError):
            self._session.close()

    def _open(self) -> bool:
        try:
            session = zenoh.open(self._config)
        except zenoh.ZError as error:
            self.fault = f"no router answers at {self._where}: {first_words(error)}"
            return False
        try:
            self._keep(session.declare_subscriber(f"{self._root}/to/{self.id}", _direct(self._came)))
            alive = session.liveliness()
            self._keep(alive.declare_subscriber(f"{self._root}/up/*", _direct(self._heard), history=True))
            self._keep(alive.declare_token(f"{self._root}/up/{self.id}"))
        except zenoh.ZError as error:
            self.fault = f"a router at {self._where} refuses: {first_words(error)}"
            with contextlib.suppress(zenoh.ZError):
                session.close()
            self._kept.clear()
            return False
        self._session = session
        return True

    def _keep(self, declared: Any) -> None:
        self._kept.append(declared)

    def _put(self, to: str, frame: bytes) -> None:
        assert self._session is not None
        publisher = self._publishers.get(to)
        if publisher is None:
            publisher = self._publishers[to] = self._session.declare_publisher(
                f"{self._root}/to/{to}",
                congestion_control=zenoh.CongestionControl.BLOCK,
                reliability=zenoh.Reliability.RELIABLE,
                priority=zenoh.Priority.DATA,  # one for all: those of different priorities overtake each other
                express=True,
            )
        try:
            publisher.put(frame)
        except zenoh.ZError as error:
            self._user.gone(to, first_words(error))

    def _undeclare(self, to: str) -> None:
        publisher = self._publishers.pop(to, None)
        if publisher is not None:
            publisher.undeclare()

    def _ask(self, place: str, answer: Answer) -> None:
        assert self._session is not None
        found: list[str] = []

        def replied(reply: zenoh.Reply) -> None:
            if reply.ok is not None and not found:
                session = reply.ok.payload.to_bytes()
                if re.fullmatch(rb"[0-9a-f]{1,32}", session):
                    found.append(session.decode())

        def over() -> None:
            if found:
                answer(found[0], "")
            elif self._session is not None and not self._session.info.routers_zid():
                answer("", f"no router answers at {self._where}")
            else:
                answer("", "connection refused")

        self._session.get(
            f"{self._root}/at/{place}",
            zenoh.handlers.Callback(replied, over, indirect=False),
            congestion_control=zenoh.CongestionControl.BLOCK,
            express=True,
            timeout=ANSWER_S,
        )

    def _listen(self, place: str) -> None:
        assert self._session is not None
        key = f"{self._root}/at/{place}"

        def asked(query: zenoh.Query) -> None:
            with query:
                query.reply(key, self.id.encode())

        self._places[place] = self._session.declare_queryable(key, _direct(asked))

    def _stop_listening(self, place: str) -> None:
        queryable = self._places.pop(place, None)
        if queryable is not None:
            queryable.undeclare()

    # In threads of Zenoh's

    def _came(self, sample: zenoh.Sample) -> None:
        if len(sample.payload) <= _LARGEST_MESSAGE:  # none of ours is larger
            self._user.came(sample.payload.to_bytes())

    def _heard(self, sample: zenoh.Sample) -> None:
        session = str(sample.key_expr).rpartition("/")[2]
        if sample.kind == zenoh.SampleKind.DELETE:
            self._user.gone(session, "its session with the routers has ended")
        else:
            self._user.there(session)


def waits_between_tries_s(draw: random.Random) -> Iterator[float]:
    """Yields how long to wait, in seconds, before a session is tried for again, each time."""
    longest_s = RETRY_S
    while True:
        yield draw.uniform(longest_s / 2, longest_s)
        longest_s = min(2 * longest_s, LONGEST_RETRY_S)


def session_config(mode: str, routers: Sequence[str], file: str, session: str, silent_s: float) -> zenoh.Config:
    """Returns the configuration of a session.

    Args:
        mode: `client` or `router`.
        routers: routers that it connects to; empty: those of the file.
        file: a configuration file of Zenoh's that says the rest; empty: none.
        session: its id; empty: one is drawn.
        silent_s: it has ended for the other side once it is silent for so long.

    Raises:
        PancakesError: the file is of no use, or a router's address is none; the sentence says why.
    """
    try:
        if file:
            check_plain(file)
        config = zenoh.Config.from_file(file) if file else zenoh.Config()
        values: dict[str, Any] = {
            "mode": mode,
            # An agent speaks to the routers that it was told of, and to no other.
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "transport/shared_memory/enabled": False,
            "transport/link/tx/lease": int(1000 * silent_s),
            "transport/link/tx/keep_alive": SAYINGS,
        }
        if session:
            values["id"] = session
        if routers:
            values["connect/endpoints"] = list(routers)
        if mode == "client":
            values["connect/timeout_ms"] = 0
        for key, value in values.items():
            config.insert_json5(key, json.dumps(value))
    except (zenoh.ZError, OSError, ValueError) as error:
        told = file or ", ".join(routers)
        raise PancakesError(f"{told} cannot be used for Zenoh: {first_words(error)}") from None
    return config


def first_words(error: Exception) -> str:
    """Returns what an error of Zenoh's says, without where in its source it says so."""
    text = str(error).partition(" at /")[0].partition("\n")[0].strip().rstrip(".!")
    return text[:1].lower() + text[1:200]


def _direct(function: Callable[[Any], None]) -> Any:
    """Has Zenoh call a function in the thread that reads, which saves a change of thread."""
    return zenoh.handlers.Callback(function, indirect=False)
