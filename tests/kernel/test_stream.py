"""The information stream: which readers get a packet, and what happens to one that no reader can take."""

import random
import threading
import weakref

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, rule

from pancakes.errors import MailboxFullError, UnknownChannelError
from pancakes.kernel.handlers import Subscription, drop_oldest, queue_policy, reliable
from pancakes.kernel.mailbox import Mailbox
from pancakes.kernel.stream import MOST_ROUTES, InformationStream
from pancakes.packet import CORE_CHANNELS, Packet


def packet(channel="system", type_name="pose", to="", seq=1, source="a/client/Source"):
    return Packet(channel, type_name, source, to, 0.0, seq, None)


class Reader:
    """A component as the stream sees it: an address and a mailbox."""

    def __init__(self, stream, address, *wanted, queue=None, addressed=False):
        self.stream, self.address, self.mailbox = stream, address, Mailbox()
        policy = queue_policy(queue or 99)
        for channel, type_name in wanted:
            stream.subscribe(address, self.mailbox, Subscription(channel, type_name, policy, addressed=addressed))

    def got(self):
        """What has come, as sequence numbers, channel by channel."""
        return [taken.seq for waiting in self.mailbox.queues.values() for taken in waiting.drain()]


def test_the_five_channels_of_the_paper_are_there_and_cannot_be_removed():
    stream = InformationStream("a")
    assert tuple(stream.channels()) == CORE_CHANNELS == ("system", "sysctrl", "ctrl", "network", "log")
    for name in CORE_CHANNELS:
        with pytest.raises(UnknownChannelError, match=f"'{name}' is a core channel"):
            stream.close(name)


def test_a_packet_reaches_the_readers_of_its_type_on_its_channel():
    stream = InformationStream("a")
    poses = Reader(stream, "a/client/Poses", ("system", "pose"))
    everything = Reader(stream, "a/client/All", ("system", None))
    others = Reader(stream, "a/client/Others", ("ctrl", "pose"), ("system", "load"))
    assert stream.publish(packet()) == 2
    assert (poses.got(), everything.got(), others.got()) == ([1], [1], [])


def test_channels_come_and_go_while_running():
    stream = InformationStream("a")
    with pytest.raises(UnknownChannelError, match="published 'pose' to 'map', but a has no such channel, only system,"):
        stream.publish(packet("map", to="a/client/T"))
    with pytest.raises(UnknownChannelError, match="published 'pose' to 'map', but a has no such channel, only system,"):
        stream.publish(packet("map"))
    stream.open("map")
    stream.open("map")  # a second time changes nothing
    reader = Reader(stream, "a/client/T", ("map", None))
    stream.publish(packet("map", seq=7))
    stream.close("map")
    with pytest.raises(UnknownChannelError):
        stream.publish(packet("map"))
    assert reader.got() == [7]
    with pytest.raises(UnknownChannelError, match="a/client/T cannot subscribe to 'map': a has no such channel"):
        Reader(stream, "a/client/T", ("map", None))
    with pytest.raises(UnknownChannelError, match="a has no channel 'map'"):
        stream.close("map")


def test_a_channel_that_is_opened_again_has_no_readers_of_former_times():
    stream = InformationStream("a")
    stream.open("map")
    reader = Reader(stream, "a/client/T", ("map", None))
    stream.close("map")
    stream.open("map")
    assert stream.publish(packet("map")) == 0
    assert reader.got() == []


def test_a_destination_here_means_the_component_or_all_that_is_under_it():
    stream = InformationStream("a")
    one = Reader(stream, "a/client/One", ("system", "pose"))
    two = Reader(stream, "a/client/Two", ("system", "pose"))
    other = Reader(stream, "a/client2/One", ("system", "pose"))
    stream.publish(packet(to="a/client/One", seq=1))
    stream.publish(packet(to="a/client", seq=2))
    stream.publish(packet(to="a", seq=3))
    assert (one.got(), two.got(), other.got()) == ([1, 2, 3], [2, 3], [3])


def test_a_reader_that_has_gone_gets_nothing_though_the_way_to_it_was_known():
    stream = InformationStream("a")
    gone = Reader(stream, "a/client/Gone", ("system", None), ("ctrl", None))
    for channel in ("system", "ctrl"):
        assert stream.publish(packet(channel)) == 1
    gone.got()
    stream.unsubscribe("a/client/Gone")
    for channel in ("system", "ctrl"):
        assert stream.publish(packet(channel)) == 0
    assert gone.got() == []


def test_a_packet_to_an_address_without_a_reader_is_counted():
    stream = InformationStream("a")
    assert stream.publish(packet(to="a/client/Nobody")) == 0
    assert stream.undelivered == 1


class Name(str):
    """A name of which one can see that it was forgotten."""


def test_a_peer_that_makes_up_destinations_fills_no_memory():
    stream = InformationStream("a")
    made_up = Name("a/client/T0")
    seen = weakref.ref(made_up)
    stream.publish(packet(to=made_up))
    del made_up
    for number in range(1, MOST_ROUTES + 1):
        stream.publish(packet(to=f"a/client/T{number}"))
    assert seen() is None and stream.undelivered == MOST_ROUTES + 1


def test_a_reader_of_addressed_packets_hears_nothing_else():
    stream = InformationStream("a")
    reader = Reader(stream, "a/device/pose", ("system", None), addressed=True)
    for seq, to in enumerate(["", "a", "*", "a/device/pose", "a/device", "a/device/motors"], start=1):
        if to != "*":
            stream.publish(packet(to=to, seq=seq))
    stream.inject(packet(to="*", seq=3))
    assert reader.got() == [4, 5]


def test_a_packet_bound_for_elsewhere_goes_to_the_gateway_and_to_no_reader_here():
    stream = InformationStream("a")
    here = Reader(stream, "a/client/T", ("system", "pose"))
    stream.publish(packet(to="b"))
    assert stream.undelivered == 1  # there is no way out yet
    sent: list[Packet] = []
    stream.gateway = sent.append
    stream.publish(packet(to="b/client/T", seq=2))
    stream.publish(packet(to="*", seq=3))
    assert [out.seq for out in sent] == [2, 3]
    assert here.got() == []
    with pytest.raises(UnknownChannelError):
        stream.publish(packet("nowhere", to="b"))


def test_what_comes_from_elsewhere_is_published_on_its_own_channel():
    stream = InformationStream("a")
    reader = Reader(stream, "a/client/T", ("system", "pose"))
    stream.gateway = lambda sent: pytest.fail("it must not go out again")
    stream.inject(packet(to="*", seq=1, source="b/client/S"))
    stream.inject(packet(to="a", seq=2, source="b/client/S"))
    stream.inject(packet(to="a/client/T", seq=3, source="b/client/S"))
    stream.inject(packet(to="a/client/U", seq=4, source="b/client/S"))
    stream.inject(packet(to="!", seq=5, source="b/client/S"))
    assert reader.got() == [1, 2, 3]


def test_where_a_reliable_reader_has_no_room_no_reader_gets_the_packet():
    """So the publisher may try again, and no reader has it twice."""
    stream = InformationStream("a")
    first = Reader(stream, "a/client/First", ("system", "pose"))
    full = Reader(stream, "a/client/Full", ("system", "pose"), queue=reliable(1))
    last = Reader(stream, "a/client/Last", ("system", "pose"))
    stream.publish(packet(seq=1))
    for to in ("", "a"):
        with pytest.raises(
            MailboxFullError, match="has no room for 'pose' from a/client/Source on 'system': 1 wait already"
        ):
            stream.publish(packet(seq=2, to=to))
    assert full.got() == [1]
    stream.publish(packet(seq=2))
    assert (first.got(), full.got(), last.got()) == ([1, 2], [2], [1, 2])


def test_a_tap_hears_what_is_published_here_until_it_is_taken_off():
    stream = InformationStream("a")
    heard: list[Packet] = []
    stream.tap("system", heard.append)
    stream.publish(packet(seq=1))
    stream.publish(packet(seq=2, to="a/client/T"))
    stream.publish(packet(seq=3, to="b"))  # goes elsewhere, and is not published here
    stream.inject(packet(seq=4, to="*"))
    stream.publish(packet("ctrl", seq=5))
    stream.untap("system", heard.append)
    stream.publish(packet(seq=6))
    assert [tapped.seq for tapped in heard] == [1, 2, 4]
    with pytest.raises(UnknownChannelError, match="a has no channel 'map'"):
        stream.tap("map", heard.append)


def test_a_tap_hears_the_types_that_it_wants_and_no_others():
    stream = InformationStream("a")
    heard: list[Packet] = []
    tap = heard.append
    stream.tap("system", tap, ("pose", "twist"))
    for seq, kind in enumerate(("pose", "load", "twist", "pose")):
        stream.publish(Packet("system", kind, "a/client/T", "", 0.0, seq, None))
    stream.untap("system", tap)
    stream.publish(Packet("system", "pose", "a/client/T", "", 0.0, 9, None))
    assert [tapped.seq for tapped in heard] == [0, 2, 3]


def test_subscribers_are_listed_in_the_order_in_which_they_came():
    stream = InformationStream("a")
    for name in ("z", "a", "m"):
        Reader(stream, f"a/client/{name}", ("system", None))
    assert stream.subscribers("system") == ["a/client/z", "a/client/a", "a/client/m"]
    stream.unsubscribe("a/client/a")
    assert stream.subscribers("system") == ["a/client/z", "a/client/m"]
    assert stream.subscribers("no such channel") == []


def test_how_a_reader_reads_is_described_and_what_waits_for_it():
    stream = InformationStream("a")
    newest = Reader(stream, "a/client/Newest", ("system", "pose"), queue=3)
    Reader(stream, "a/client/Sure", ("system", "pose"), ("system", "word"), queue=reliable(7))
    for seq in range(1, 6):
        stream.publish(packet(seq=seq))
    first, second = stream.describe("system")
    assert first["address"] == newest.address
    assert (first["queue"], first["limit"], first["waiting"], first["dropped"]) == ("3", 3, 3, 2)
    assert (second["queue"], second["limit"], second["waiting"], second["dropped"]) == ("reliable(7)", 14, 5, 0)
    assert first["waiting_bytes"] == 0, "none is heavy"
    assert [it["channel"] for it in stream.readings(newest.address)] == ["system"]
    assert stream.readings("a/client/Nobody") == []


def test_stream_describes_a_queue_as_its_author_wrote_it():
    stream = InformationStream("a")
    reader = Reader(stream, "a/client/R", ("system", "pose"), queue="latest")
    assert stream.readings(reader.address)[0]["queue"] == "latest"
    stream.subscribe(reader.address, reader.mailbox, Subscription("system", "word", queue_policy(4)))
    assert (found := stream.readings(reader.address)[0])["queue"] == "latest, 4" and found["limit"] == 5
    with pytest.raises(UnknownChannelError, match="no channel 'sytem', did you mean 'system'"):
        stream.describe("sytem")


def test_a_component_with_two_subscriptions_gets_a_packet_once():
    stream = InformationStream("a")
    reader = Reader(stream, "a/client/T", ("system", "pose"), ("system", None))
    assert stream.publish(packet()) == 1
    assert reader.got() == [1]


def test_many_threads_publish_while_readers_come_and_go():
    """A reader that was there all the time misses nothing, and hears each publisher in order."""
    stream = InformationStream("a")
    steady = Reader(stream, "a/client/Steady", ("system", "pose"), queue=100_000)
    begin = threading.Barrier(5)

    def publish(number):
        begin.wait()
        for seq in range(500):
            stream.publish(packet(seq=seq, source=f"a/client/{number}"))

    def come_and_go():
        begin.wait()
        for number in range(200):
            Reader(stream, f"a/client/R{number % 7}", ("system", "pose"))
            stream.unsubscribe(f"a/client/R{random.Random(number).randrange(7)}")

    threads = [threading.Thread(target=publish, args=(number,)) for number in range(4)]
    threads.append(threading.Thread(target=come_and_go))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    got = list(steady.mailbox.queues["system"].drain())
    for number in range(4):
        assert [taken.seq for taken in got if taken.source == f"a/client/{number}"] == list(range(500))


class StreamModel(RuleBasedStateMachine):
    """Any order of subscribing, leaving, opening, closing and publishing, against a table of what each reader wants."""

    channels = Bundle("channels")

    def __init__(self):
        super().__init__()
        self.stream = InformationStream("a")
        self.mailboxes = {}
        self.wants = {}  # (address, channel) -> types
        self.open = dict.fromkeys(CORE_CHANNELS)
        self.seq = 0

    @rule(target=channels, name=st.sampled_from(["system", "map", "plan"]))
    def open_channel(self, name):
        self.stream.open(name)
        self.open[name] = None
        return name

    @rule(name=channels)
    def close_channel(self, name):
        if name in CORE_CHANNELS or name not in self.open:
            with pytest.raises(UnknownChannelError):
                self.stream.close(name)
            return
        self.stream.close(name)
        del self.open[name]
        self.wants = {key: types for key, types in self.wants.items() if key[1] != name}

    @rule(
        who=st.sampled_from(["a/client/x", "a/client/y", "a/device/z"]),
        channel=channels,
        type_name=st.sampled_from(["pose", "load", None]),
    )
    def subscribe(self, who, channel, type_name):
        mailbox = self.mailboxes.setdefault(who, Mailbox())
        subscription = Subscription(channel, type_name, drop_oldest(999))
        if channel not in self.open:
            with pytest.raises(UnknownChannelError):
                self.stream.subscribe(who, mailbox, subscription)
            return
        self.stream.subscribe(who, mailbox, subscription)
        self.wants.setdefault((who, channel), []).append(type_name)

    @rule(who=st.sampled_from(["a/client/x", "a/client/y"]))
    def leave(self, who):
        self.stream.unsubscribe(who)
        self.wants = {key: types for key, types in self.wants.items() if key[0] != who}

    @rule(
        channel=channels,
        type_name=st.sampled_from(["pose", "load"]),
        to=st.sampled_from(["", "a", "a/client", "a/client/x", "a/cli"]),
    )
    def publish(self, channel, type_name, to):
        self.seq += 1
        sent = packet(channel, type_name, to, self.seq)
        if channel not in self.open:
            with pytest.raises(UnknownChannelError):
                self.stream.publish(sent)
            return
        expected = [
            who
            for (who, on), types in self.wants.items()
            if on == channel
            and (type_name in types or None in types)
            and (not to or who == to or who.startswith(to + "/"))
        ]
        assert self.stream.publish(sent) == len(expected)
        for who, mailbox in self.mailboxes.items():
            waiting = mailbox.queues.get(channel)
            taken = [got.seq for got in waiting.drain()] if waiting is not None else []
            assert taken == ([self.seq] if who in expected else [])


StreamModel.TestCase.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)
test_any_use_of_the_stream_agrees_with_its_model = StreamModel.TestCase
