"""Feeding sends packets at their times, waits for slow agents, and reports them."""

import pytest

from pancakes.control import Describe
from pancakes.devices import Load
from pancakes.errors import ControlRefusedError, PeerLostError, UnreachableError
from pancakes.packet import Packet
from pancakes.recording.records import RecordedPacket
from pancakes.tools.replay.replay import Feeder, Live, Selection


class Door:
    """Leads to the agent `a`; takes a packet in `slow_s`."""

    def __init__(self, client, slow_s):
        self.client = client
        self.slow_s = slow_s
        self.there = True
        self.sent = []
        self._free_s = 0.0

    def connected(self, agent):
        return self.there and agent == "a"

    def waiting(self, agent):
        return int(self.client.now() < self._free_s)

    def send(self, packet):
        if not self.there:
            raise PeerLostError(f"{packet.type} cannot go to a")
        self.sent.append((pytest.approx(self.client.now()), packet))
        self._free_s = self.client.now() + self.slow_s


class Client:
    """A client with a clock of its own: a wait advances it, by a little more than requested."""

    timeout_s = 3.0

    def __init__(self, slow_s=0.0):
        self.time_s = 100.0
        self.door = Door(self, slow_s)
        self.asked = []

    def now(self):
        return self.time_s

    def wait(self, condition, timeout_s=timeout_s):
        until_s = self.time_s + timeout_s
        while self.time_s < until_s and not condition():
            self.time_s += 0.01

    def is_connected(self, agent):
        return self.door.connected(agent)

    def waiting(self, agent):
        return self.door.waiting(agent)

    def send(self, packet):
        self.door.send(packet)

    def request(self, agent, body):
        self.asked.append((agent, body))


def entries(count):
    return [
        RecordedPacket(int((50 + n) * 1e9), "a", Packet("system", "load", "a/device/load", "", 7.0 + n, n, Load(0.5)))
        for n in range(count)
    ]


def feeder(client, said=None, **agents):
    agents = agents or {"a": 1.0}
    live = {name: Live(name, ("system",), frozenset(), 40.0, speed) for name, speed in agents.items()}
    return Feeder(client, Selection(live), said.append if said is not None else lambda text: None)


def test_feeding_does_not_drift():
    client = Client()
    feeding = feeder(client)
    feeding.feed(entries(50), int(50e9), speed=2.0, recorded_speed=1.0)
    times = [time_s for time_s, _ in client.door.sent]
    assert len(times) == 50
    # Each wait ends up to 10 ms late; the last of fifty is no later than the second.
    assert times[-1] == pytest.approx(100.0 + 49 / 2.0, abs=0.02)
    assert [packet.stamp_s for _, packet in client.door.sent][-1] == pytest.approx(40.0 + 49 / 2.0, abs=0.02)
    feeding.settle()
    assert client.asked == [("a", Describe())]
    assert feeding.tally.fed() == 50


@pytest.mark.parametrize(("recorded_speed", "speed", "last_s"), [(5.0, 5.0, 3.0), (5.0, 1.0, 15.0), (1.0, 5.0, 0.6)])
def test_feeding_keeps_mission_time(recorded_speed, speed, last_s):
    client = Client()
    feeder(client, a=speed).feed(entries(4), int(50e9), speed=1.0, recorded_speed=recorded_speed)
    assert client.door.sent[-1][0] == pytest.approx(100.0 + last_s, abs=0.02)


def test_slow_agent_is_waited_for_and_reported_once():
    client, said = Client(slow_s=2.0), list[str]()
    feeder(client, said).feed(entries(10), int(50e9), speed=1.0, recorded_speed=1.0)
    times = [packet.stamp_s for _, packet in client.door.sent]
    assert len(times) == 10
    assert times[-1] - times[0] == pytest.approx(18.0, abs=0.3)
    assert said == ["a is too slow: the replay waits for it, and is 1.0 s late"]


def test_feeding_ends_if_an_agent_goes_away():
    client = Client()
    client.door.there = False
    with pytest.raises(UnreachableError, match="after 0 packets: a went away"):
        feeder(client).feed(entries(3), int(50e9), speed=1.0, recorded_speed=1.0)


def test_missions_at_different_speeds_are_refused():
    with pytest.raises(ControlRefusedError, match="different speeds: a at 1, b at 5"):
        feeder(Client(), a=1.0, b=5.0).feed(entries(1), int(50e9), speed=1.0, recorded_speed=1.0)
    client = Client()
    feeder(client, a=0.0, b=5.0).feed(entries(2), int(50e9), speed=1.0, recorded_speed=5.0)
    assert [packet.stamp_s for _, packet in client.door.sent] == [40.0, 40.0]
