"""The page beside a demo: `pancakes demo NAME --view`."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING

from pancakes.tools.cli.output import show_text

if TYPE_CHECKING:
    from pancakes.tools.demo.conductor import Mission
    from pancakes.tools.demo.demo_plan import DemoPlan
    from pancakes.tools.web.feed import Feed
    from pancakes.tools.web.page import Shown
    from pancakes.tools.web.page_server import PageServer
    from pancakes.tools.web.virtual_watch import VirtualWatch
    from pancakes.tools.web.watch import Watch


class DemoPage:
    """One page for all missions of a demo, one after the other.

    Args:
        control: whether it may change something.
        port: its port, see `open_page`.
        speed: mission seconds for each second, in virtual time.
        interrupted: ends all waiting.
    """

    def __init__(self, control: bool, port: int | None, speed: float, interrupted: threading.Event) -> None:
        self._control = control
        self._port = port
        self._speed = speed
        self._interrupted = interrupted
        self._server: PageServer | None = None
        self._watch: Watch | None = None
        self._feed: Feed | None = None

    @property
    def address(self) -> str:
        """Its address; empty while it is not served."""
        return self._server.address if self._server is not None else ""

    def beside_live(self, plan: DemoPlan, mission: Mission) -> None:
        """Shows a mission of processes; to be called before they start."""
        from pancakes.tools.web.feed import Feed
        from pancakes.tools.web.page import Shown
        from pancakes.tools.web.watch import Watch

        began_s = time.monotonic()
        feed = Feed(lambda: time.monotonic() - began_s)
        feed.wait_for("the agents start")
        fleet = next(iter(plan.configs.values())).agent.fleet
        watch = Watch(feed, plan.peers(within_machine=True), fleet, over=lambda: mission.ended)
        self._show(Shown(feed, watch.explain, watch.order, watch.order if self._control else None, plan.demo.title))
        self._stop_watching()
        self._watch = watch
        watch.start()

    def beside_virtual(self, title: str) -> VirtualWatch:
        """Shows a mission in virtual time; returns the watch that the mission feeds."""
        from pancakes.tools.web.page import Shown
        from pancakes.tools.web.virtual_watch import VirtualWatch

        watch = VirtualWatch(self._speed, self._interrupted)
        self._show(Shown(watch.feed, watch.explain, watch.look, None, title))
        return watch

    def end(self, sentence: str) -> None:
        """Says how the mission went."""
        self._stop_watching()
        if self._feed is not None:
            self._feed.end(sentence)

    def stay(self) -> None:
        """Serves the page until Ctrl-C."""
        if self._server is not None:
            show_text(f"the page stays at {self._server.address} until Ctrl-C")
            self._interrupted.wait()

    def close(self) -> None:
        """Takes the page away."""
        self._stop_watching()
        if self._server is not None:
            self._server.close()

    def _show(self, shown: Shown) -> None:
        from pancakes.tools.cli.verbs.view import tell_address
        from pancakes.tools.web.page import open_page

        self._feed = shown.feed
        if self._server is not None:
            self._server.show(shown)
            return
        self._server = open_page(shown, self._port)
        tell_address(self._server.address, self._control)

    def _stop_watching(self) -> None:
        if self._watch is not None:
            self._watch.close()
            self._watch = None
