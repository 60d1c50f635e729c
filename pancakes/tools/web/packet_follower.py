"""Follow the packets of a running fleet that pages plot, in a thread of its own, only while a page plots them.

The watch of a page follows few types of packets. For the others this module is a second client of the mesh, so that an
agent that answers slowly does not delay the page. It ends `WANTED_S` after the last page has asked.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from typing import Final

from pancakes.client.session import Session
from pancakes.client.subscriptions import Subscription, SubscriptionSpec
from pancakes.errors import PancakesError
from pancakes.packet import CORE_CHANNELS, CTRL, SYSTEM
from pancakes.tools.web.feed import Feed
from pancakes.tools.web.series import HIGHEST_HZ

TURN_S: Final = 0.1
"""How often arrived packets are taken, in seconds."""
IDLE_S: Final = 0.2
"""How often it looks whether a page wants packets, in seconds."""
AGAIN_S: Final = 2.0
"""The pause after agents could not be reached, and between two looks for new channels, in seconds."""

Wanted = Mapping[str, tuple[str, ...]] | None
"""Types by channel, as `SeriesStore.wanted` returns them; None: all of all channels."""


class PacketFollower:
    """Bring the packets that pages want into the series of a feed, from `start` to `close`.

    Args:
        feed: the feed.
        at: addresses to begin with; empty: the agents of this machine.
        fleet: returns the fleet; empty while it is not known yet.
        timeout_s: the time limit for the first questions, in seconds.
    """

    def __init__(self, feed: Feed, at: Sequence[str], fleet: Callable[[], str], timeout_s: float) -> None:
        self._feed = feed
        self._at = tuple(at)
        self._fleet = fleet
        self._timeout_s = timeout_s
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="page-series", daemon=True)

    def start(self) -> None:
        """Begin to look for what pages want."""
        self._thread.start()

    def close(self) -> None:
        """Stop. Not from its own thread."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join()

    def _run(self) -> None:
        while not self._stopping.wait(IDLE_S):
            if not self._fleet() or self._wanted() == {}:
                continue
            try:
                with Session(self._at, self._timeout_s) as session:
                    self._follow_while_wanted(session)
            except PancakesError:  # the page itself shows that no agent answers
                self._stopping.wait(AGAIN_S)

    def _wanted(self) -> Wanted:
        return self._feed.wanted_packets()

    def _follow_while_wanted(self, session: Session) -> None:
        session.describe()
        session.use_fleet(self._fleet())
        while not self._stopping.is_set() and (wanted := self._wanted()) != {}:
            with ExitStack() as stack:
                self._follow(session, [stack.enter_context(it) for it in self._subscriptions(session, wanted)], wanted)

    def _subscriptions(self, session: Session, wanted: Wanted) -> list[Subscription]:
        """Return a subscription to each channel; a channel that no agent has any more is left out."""
        found = []
        for channel, types in (_all_channels(session) if wanted is None else wanted).items():
            spec = SubscriptionSpec(channel=channel, types=types, include_remote=True, max_hz=HIGHEST_HZ)
            try:
                found.append(Subscription(session, spec))
            except PancakesError:
                continue
        return found

    def _follow(self, session: Session, subscriptions: Sequence[Subscription], wanted: Wanted) -> None:
        """Take packets until pages want others, or until it is time to look for new channels."""
        followed = {subscription.channel for subscription in subscriptions}
        until_s = session.now() + AGAIN_S
        while not self._stopping.wait(TURN_S):
            for subscription in subscriptions:
                self._take(session, subscription)
            now = self._wanted()
            if now != wanted:
                return
            if now is None and session.now() >= until_s:
                until_s = session.now() + AGAIN_S
                if _all_channels(session).keys() - followed:
                    return

    def _take(self, session: Session, subscription: Subscription) -> None:
        subscription.keep_alive()
        heard = []
        while (it := subscription.take()) is not None:
            heard.append(it)
        if not heard:
            return
        now, now_s = self._feed.now(), session.now()
        with self._feed.lock:
            for it in heard:
                self._feed.model.series.take(it.packet, now - (now_s - it.at_s))


def _all_channels(session: Session) -> dict[str, tuple[str, ...]]:
    """Return the channels whose packets have numbers: readings, commands, and the channels of tasks."""
    own = {name for it in session.describe().agents for name in it["channels"] if name not in CORE_CHANNELS}
    return dict.fromkeys((SYSTEM, CTRL, *sorted(own)), ())
