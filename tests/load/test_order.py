"""What one source publishes on one channel comes in order, whatever its types, at any load; and nothing comes twice."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel.actors import put_back
from torture.live import free_ports
from torture.load_fleet import LoadedFleet
from torture.proxy import Proxy

from pancakes.errors import MailboxFullError
from pancakes.kernel.handlers import LATEST, QueuePolicy, Subscription, drop_oldest, reliable
from pancakes.kernel.mailbox import Mailbox
from pancakes.kernel.stream import InformationStream
from pancakes.packet import Packet

KINDS = ("pose", "battery", "blob")
CUTS = 3


class Dispatcher:
    """Gives no turns: the test reads the mailboxes itself."""

    def ready(self, mailbox: Mailbox) -> None:
        pass


class Reader:
    """A reader of one channel, and what it has read."""

    def __init__(self, stream: InformationStream, name: str, keeps: dict[str | None, QueuePolicy]) -> None:
        self.mailbox = Mailbox()
        self.mailbox.dispatch = Dispatcher()
        put_back(self.mailbox)
        self.keeps = keeps
        self.read: list[int] = []
        for kind, keep in keeps.items():
            stream.subscribe(f"a/client/{name}", self.mailbox, Subscription("system", kind, keep))

    def take(self) -> bool:
        """Reads one packet; returns whether there was one."""
        packet = self.mailbox.take()
        self.read += [packet.seq] if packet is not None else []
        return packet is not None

    def loses_none(self, kind: str) -> bool:
        """Whether it must get each packet of a type."""
        keep = self.keeps.get(kind, self.keeps.get(None))
        return keep is not None and keep.reliable


KEEPS = st.one_of(st.just(LATEST), st.builds(drop_oldest, st.integers(1, 4)), st.builds(reliable, st.integers(1, 4)))
READERS = st.lists(st.dictionaries(st.sampled_from((*KINDS, None)), KEEPS, min_size=1), min_size=1, max_size=4)
STEPS = st.lists(st.one_of(st.sampled_from(KINDS), st.integers(0, 3)), max_size=60)


@given(READERS, STEPS, st.booleans())
def test_a_refused_packet_that_is_published_again_comes_once_to_everybody_and_in_order(readers, steps, heavy):
    stream = InformationStream("a")
    made = [Reader(stream, f"R{index}", keeps) for index, keeps in enumerate(readers)]
    body = {"data": bytes(2000)} if heavy else {}
    published: dict[int, str] = {}
    for seq, step in enumerate(steps, start=1):
        if isinstance(step, int):
            made[step % len(made)].take()
            continue
        for _ in range(50):
            try:
                stream.publish(Packet("system", step, "a/client/Source", "", 0.0, seq, body))
                break
            except MailboxFullError:
                for reader in made:
                    reader.take()
        published[seq] = step
    for reader in made:
        while reader.take():
            pass
        assert reader.read == sorted(set(reader.read)), "in order, and none twice"
        missed = set(published) - set(reader.read)
        assert not any(reader.loses_none(published[seq]) for seq in missed), "a reliable reader lost one"


@pytest.fixture
def cut_fleet(tmp_path: Path) -> Iterator[tuple[LoadedFleet, Proxy]]:
    """Two agents between which all goes through a proxy that cuts the link."""
    here, there = (f"tcp://127.0.0.1:{port}" for port in free_ports(2))
    tasks: dict[str, Any] = {"a": {"Flood": {"to": "b", "size": 131_072}}, "b": {"ReliableReader": {"work_s": 0.0005}}}
    with (
        closing(Proxy(there)) as proxy,
        closing(LoadedFleet(tmp_path, tasks, {"a": [proxy.address], "b": []}, {"a": here, "b": there})) as fleet,
    ):
        yield fleet, proxy


def test_nothing_overtakes_or_comes_twice_over_a_link_that_is_cut_again_and_again(cut_fleet):
    """The publisher is too fast for the link, publishes again what is refused, and has the link cut under it."""
    fleet, proxy = cut_fleet
    fleet.running["a"].hear("b (agent")
    fleet.configure("a", "Flood", per_s=10_000.0)
    for _ in range(CUTS):
        before = fleet.last("a", "Flood").get("refused", 0)
        fleet.wait(lambda before=before: fleet.last("a", "Flood").get("refused", 0) > before, "refusals")
        proxy.cut.clear()
        proxy.cut_at("load.mark")
        assert proxy.cut.wait(20.0)
        proxy.heal()
        fleet.running["a"].hear("b (agent")
    fleet.configure("a", "Flood", per_s=20.0)
    published = fleet.last("a", "Flood")["published"]
    fleet.wait(lambda: fleet.last("b", "ReliableReader")["last"] > published, "packets after the last cut")
    read = fleet.last("b", "ReliableReader")
    assert (read["disordered"], read["doubled"]) == (0, 0)
