"""Packets of one stream that came from another agent together are put into the mailboxes together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest
from kernel.actors import put_back

from pancakes.errors import MailboxFullError, UnknownChannelError
from pancakes.kernel.handlers import Subscription, drop_oldest, reliable
from pancakes.kernel.mailbox import Mailbox
from pancakes.kernel.payload_size import LIGHT_BYTES
from pancakes.kernel.stream import InformationStream
from pancakes.packet import Packet, packet_type


class Dispatch:
    """Counts how often a reader is told that something waits."""

    def __init__(self):
        self.readied = []

    def ready(self, mailbox):
        self.readied.append(mailbox)


class Reader:
    """A component as the stream sees it, which waits for something to do."""

    def __init__(self, stream, address, **keeps):
        self.mailbox = Mailbox()
        self.mailbox.dispatch = self.dispatch = Dispatch()
        put_back(self.mailbox)
        for name, keep in keeps.items():
            stream.subscribe(address, self.mailbox, Subscription("system", name, keep))

    @property
    def queue(self):
        return self.mailbox.queues["system"]

    def got(self):
        return [taken.seq for taken in self.queue.drain()]


def packets(*seqs, to="*", body=None):
    return [Packet("system", "pose", "b/client/S", to, 0.0, seq, body) for seq in seqs]


def nobody(packet, error):
    pytest.fail(f"{packet.seq}: {error}")


KEEPS = {
    "one subscription": {"pose": drop_oldest(5)},
    "several": {"pose": drop_oldest(5), "ir": drop_oldest(2)},
    "several, one of them reliable": {"pose": drop_oldest(5), "ir": reliable(2)},
}


@pytest.mark.parametrize("keeps", KEEPS.values(), ids=KEEPS)
@pytest.mark.parametrize("body", [None, bytes(LIGHT_BYTES + 1)], ids=["light", "heavy"])
def test_all_come_in_their_order_and_the_reader_is_told_once(keeps, body):
    stream = InformationStream("a")
    reader = Reader(stream, "a/client/T", **keeps)
    for run in (packets(1, 2, body=body), packets(3, body=body)):  # the second finds the way known
        stream.inject_all(run, nobody)
    assert reader.dispatch.readied == [reader.mailbox]
    assert reader.got() == [1, 2, 3] and reader.queue.dropped() == 0


@pytest.mark.parametrize("keeps", KEEPS.values(), ids=KEEPS)
def test_where_there_are_too_many_the_oldest_fall_out_and_are_counted(keeps):
    stream = InformationStream("a")
    reader = Reader(stream, "a/client/T", **keeps)
    stream.inject_all(packets(1), nobody)
    stream.inject_all(packets(*range(2, 10)), nobody)
    assert reader.queue.dropped() == 4
    assert reader.got() == [5, 6, 7, 8, 9]


def test_a_destination_is_kept_to():
    stream = InformationStream("a")
    one, other = Reader(stream, "a/client/T", pose=drop_oldest(9)), Reader(stream, "a/client/U", pose=drop_oldest(9))
    for _ in range(2):
        stream.inject_all(packets(1, 2, to="a/client/U"), nobody)
    assert one.got() == [] and other.got() == [1, 2, 1, 2]
    stream.inject_all(packets(1, 2, to="a/client/V"), nobody)
    assert stream.undelivered == 2


def test_a_tap_hears_each_of_them():
    stream = InformationStream("a")
    reader, heard = Reader(stream, "a/client/T", pose=drop_oldest(9)), list[Packet]()
    stream.tap("system", heard.append)
    for run in (packets(1, 2), packets(3, 4)):
        stream.inject_all(run, nobody)
    assert reader.got() == [it.seq for it in heard] == [1, 2, 3, 4]


def test_what_finds_no_room_is_told_one_by_one():
    stream = InformationStream("a")
    Reader(stream, "a/client/T", pose=reliable(2))
    other, refused = Reader(stream, "a/client/U", pose=drop_oldest(9)), []
    stream.inject_all(packets(1, 2, 3, 4), lambda packet, error: refused.append((packet.seq, type(error))))
    assert refused == [(3, MailboxFullError), (4, MailboxFullError)]
    assert other.got() == [1, 2, 3, 4]


def test_what_is_for_no_channel_is_told_one_by_one():
    stream, refused = InformationStream("a"), []
    run = [Packet("nowhere", "pose", "b/client/S", "", 0.0, seq, None) for seq in (1, 2)]
    stream.inject_all(run, lambda packet, error: refused.append((packet.seq, type(error))))
    assert refused == [(1, UnknownChannelError), (2, UnknownChannelError)]


TEXT = "test.text_of_a_run"


@packet_type(TEXT)
@dataclass(frozen=True)
class Text:
    text: str = ""
    number: int = 0


@pytest.mark.parametrize(
    ("size", "heavy"), [(2 * LIGHT_BYTES, 0), (2 * LIGHT_BYTES + 2, 2 * LIGHT_BYTES + 2), (None, LIGHT_BYTES + 100)]
)
def test_what_came_together_weighs_what_it_took_on_the_wire(size, heavy):
    """Where that is not known each is weighed by itself."""
    stream = InformationStream("a")
    reader = Reader(stream, "a/client/T", **{TEXT: drop_oldest(9)})
    bodies = [Text(), Text("x" * (LIGHT_BYTES + 100)), Text("x" * 40)]
    first, *run = [Packet("system", TEXT, "b/client/S", "*", 0.0, seq, it) for seq, it in enumerate(bodies, start=1)]
    stream.inject_all([first], nobody, 20)  # the others find the route known
    stream.inject_all(run, nobody, size)
    assert reader.queue.heavy_bytes == pytest.approx(heavy, abs=100)
    assert reader.got() == [1, 2, 3] and reader.queue.heavy_bytes == 0


def test_light_ones_that_came_together_weigh_nothing():
    stream = InformationStream("a")
    reader = Reader(stream, "a/client/T", pose=drop_oldest(9))
    stream.inject_all(packets(1), nobody, 20)
    stream.inject_all(packets(2, 3), nobody, 40)
    assert reader.queue.heavy_bytes == 0
    assert reader.got() == [1, 2, 3]


def test_a_reader_that_subscribes_while_another_has_no_room_costs_the_others_nothing():
    """What came from another agent does not come again, so each reader with room is to get it."""
    stream, refused = InformationStream("a"), []
    full = Reader(stream, "a/client/Full", pose=reliable(1))
    other = Reader(stream, "a/client/Other", pose=drop_oldest(9))

    class ActorCore:
        """The reader that the refusal names, which is said just before the others get the packet."""

        @property
        def address(self):
            Reader(stream, "a/client/New", ir=drop_oldest(9))
            return "a/client/Full"

    component: Any = ActorCore()
    full.mailbox.component = component
    stream.inject_all(packets(1, 2), lambda packet, error: refused.append(packet.seq))
    assert refused == [2] and full.got() == [1] and full.queue.dropped() == 1
    assert other.got() == [1, 2]
