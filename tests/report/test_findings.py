"""The findings of a report: packets in, plain data out; nothing is drawn."""

import sys
from itertools import pairwise

import pytest

from pancakes.control import Hold
from pancakes.devices import Battery, Pose, Twist
from pancakes.events import Event, LogLine
from pancakes.packet import Fence, Packet
from pancakes.recording.clock_alignment import MissionTime
from pancakes.recording.records import RecordedPacket
from pancakes.recording.task_statistics import OneLink, OneTask, TaskFigures, TimerFigures
from pancakes.sim.world_state import BodyState, WorldState
from pancakes.tools.report.findings import Findings
from pancakes.tools.report.performance import Rates, TimerRates
from pancakes.tools.report.summary import Summary
from pancakes.tools.report.time_series import MOST_POINTS, MOST_SLOTS, Counts, Distribution, TimeSeries

S = 1_000_000_000
SCAN = "a/Scan"


class Book:
    """Builds a recording, in the order of time."""

    def __init__(self):
        self.entries = []
        self._seqs = {}

    def see(self, t_s, agent, source, body, kind, channel="system", to="", cause=None, fence=None):
        seq = self._seqs[source] = self._seqs.get(source, 0) + 1
        packet = Packet(channel, kind, source, to, t_s, seq, body, cause, fence)
        self.entries.append(RecordedPacket(round(t_s * S), agent, packet))
        return packet

    def arrive(self, t_s, agent, packet):
        self.entries.append(RecordedPacket(round(t_s * S), agent, packet))

    def event(self, t_s, agent, kind, **fields):
        self.see(t_s, agent, f"{agent}/client", Event(kind, fields), "event", "log")

    def find(self, task_id=""):
        self.entries.sort(key=lambda entry: entry.time_ns)
        return Findings.of(self.entries, task_id)


@pytest.fixture
def book():
    return Book()


def move(book, at_s=10.0):
    """Record that Scan runs on a, is paused, and runs on b."""
    book.event(1.0, "a", "task_started", task="Scan", service="client", epoch=0)
    book.see(at_s - 0.1, "a", "a/client/Scan", Twist(0.1, 0.0), "motors", "ctrl", fence=Fence(SCAN, (0, "a")))
    book.event(at_s, "a", "task_frozen", task="Scan", offer=1)
    book.event(at_s + 0.02, "a", "task_stopped", task="Scan", service="client", reason="handed over to b")
    book.event(at_s + 0.03, "b", "task_started", task="Scan", service="client", epoch=1)
    book.see(at_s + 0.1, "b", "b/client/Scan", Twist(0.1, 0.0), "motors", "ctrl", fence=Fence(SCAN, (1, "a")))
    lines = [
        {"peer": "b", "answer": "bid", "fate": "won", "cost": 1.0, "terms": {}, "reason": ""},
        {"peer": "c", "answer": "refused", "fate": "refused", "cost": None, "terms": {}, "reason": "lacks motors"},
    ]
    ledger = {"task": "Scan", "task_id": SCAN, "source": "a", "asked_by": "rule", "cost": "tasks", "outcome": "moved"}
    book.event(at_s + 0.05, "a", "migration", **ledger, winner="b", lines=lines, duration_s=0.5, offer="1@a")
    book.see(20.0, "b", "b/client/Scan", Twist(0.1, 0.0), "motors", "ctrl", fence=Fence(SCAN, (1, "a")))
    book.event(20.5, "a", "tick")


def test_timeline_follows_a_task_over_agents(book):
    move(book)
    lanes = book.find().timeline.lanes
    (on_a,) = lanes["a", "client", "Scan"].spans
    (on_b,) = lanes["b", "client", "Scan"].spans
    assert (on_a.from_s, on_a.to_s, on_a.ended) == (1.0, pytest.approx(10.02), "handed over to b")
    assert (on_b.from_s, on_b.epoch, on_b.ended) == (pytest.approx(10.03), 1, "")
    assert on_b.to_s == pytest.approx(20.0)  # b was last seen then


def test_timeline_has_a_gap_while_an_agent_is_gone(book):
    def figures(t_s, mission_s, ticks):
        timer = TimerFigures("tick", 10.0, ticks, 0, 0.0, 0.0)
        body = TaskFigures(mission_s, (OneTask("client/Scan", SCAN, 1, 0, 0, (timer,)),))
        book.see(t_s, "a", "a/log/Recorder", body, "task_figures", "recording")

    book.event(1.0, "a", "task_started", task="Scan", service="client", epoch=0)
    figures(2.0, 2.0, 10)
    figures(3.0, 3.0, 20)
    # The agent is killed here; its mission time begins at 0 again.
    body = Event("recording_started", {"path": "a.mcap"})
    book.see(9.0, "a", "a/log/Recorder", body, "event", "log")
    book.event(9.5, "a", "task_started", task="Scan", service="client", epoch=0)
    figures(12.0, 2.5, 25)
    figures(13.0, 3.5, 35)
    found = book.find()
    spans = found.timeline.lanes["a", "client", "Scan"].spans
    assert [(span.from_s, span.to_s, span.ended) for span in spans] == [(1.0, 3.0, "not recorded"), (9.5, 13.0, "")]
    timer = found.rates.timers["a", "client/Scan", "tick"]
    assert timer.ticks == 10 + 25 + 10
    assert timer.at[0].achieved_hz is None or timer.at[0].achieved_hz == pytest.approx(10.0)


def taken(book, reason="the other side closed the connection"):
    """Record that a runs Scan until 5 s, that b loses the link, and that guardians have b run Scan at 7 s."""
    book.event(1.0, "a", "task_started", task="Scan", service="client", epoch=0)
    book.event(1.0, "b", "tick")
    book.event(5.0, "a", "tick")
    book.event(5.1, "b", "peer_down", peer="a", reason=reason)
    book.event(20.0, "b", "tick")


def test_lost_agent_is_found(book):
    taken(book)
    book.event(7.0, "b", "task_started", task="Scan", service="client", epoch=1)
    book.event(7.0, "b", "taken_over", task="Scan", source_agent="a", by="b")
    ledger = {"task_id": SCAN, "source": "a", "asked_by": "guardians", "cost": "tasks", "outcome": "moved"}
    book.event(7.1, "b", "migration", **ledger, winner="b", lines=[], duration_s=0.5)
    found = book.find()
    (loss,) = found.losses.losses
    assert (loss.agent, loss.at_s) == ("a", 5.0)
    (on_a,) = found.timeline.lanes["a", "client", "Scan"].spans
    (on_b,) = found.timeline.lanes["b", "client", "Scan"].spans
    assert (on_a.to_s, on_a.ended, on_b.ended) == (5.0, "lost", "")
    (entry,) = [it for it in found.events.grave if it.kind == "agent_lost"]
    assert entry.text == (
        "a was lost: its recording ends here, and the link to it ended on b (the other side closed the connection)"
    )
    it = Summary.of(found)
    assert (it.errors, it.lost_agents, it.moved, it.taken_over) == (1, ("a",), 1, 1)
    assert found.moves.moves[0].outcome == "taken over"


def test_lost_agent_that_comes_back_was_lost(book):
    taken(book)
    book.see(12.0, "a", "a/log/Recorder", Event("recording_started", {"path": "a.mcap"}), "event", "log")
    book.event(12.5, "a", "task_started", task="Scan", service="client", epoch=2)
    found = book.find()
    assert [(loss.agent, loss.at_s) for loss in found.losses.losses] == [("a", 5.0)]
    assert [span.ended for span in found.timeline.lanes["a", "client", "Scan"].spans] == ["lost", ""]


@pytest.mark.parametrize("case", ["stops", "cut off", "shut down", "long after"])
def test_agent_that_is_not_lost(book, case):
    taken(book, {"stops": "a stopped"}.get(case, "it is silent"))
    if case == "cut off":  # its recording goes on
        book.event(8.0, "a", "tick")
    elif case == "shut down":
        book.event(4.9, "a", "asked", what="shutdown", by="cli-1")
    elif case == "long after":
        book.entries = [it for it in book.entries if it.time_ns < 5.05 * S]
        book.event(45.0, "b", "peer_down", peer="a", reason="it is silent")
    found = book.find()
    assert found.losses.losses == []
    assert not [it for it in found.events.grave if it.kind == "agent_lost"]


def test_terminals_are_not_between_agents(book):
    for name in ("cli-25166-436cad", "cli-25166-436cad.1", "ann.1a2b3c4d"):
        book.see(1.0, "a", "a/client", Twist(0.1, 0.0), "reply", "sysctrl", to=name)
        packet = book.see(1.0, "b", f"{name}/x", Twist(0.1, 0.0), "stop", "sysctrl", to="a")
        book.arrive(1.1, "a", packet)
    book.see(2.0, "a", "a/client", Twist(0.1, 0.0), "motors", to="unrecorded")
    traffic = book.find().traffic
    assert traffic.links.names() == ["a → unrecorded"]
    assert traffic.channels.names() == ["system"]
    assert traffic.terminals == 9


def test_timers_of_a_task_have_different_names():
    rates = Rates()
    for task, timer in (("client/Patrol", "drive"), ("client/Patrol", "tell"), ("client/Scan", "tick")):
        rates.timers["a", task, timer] = TimerRates("a", task, "", timer)
    names = [rates.name(timer) for timer in rates.timers.values()]
    assert names == ["client/Patrol.drive", "client/Patrol.tell", "client/Scan"]


def test_findings_are_in_mission_time(book):
    move(book)
    book.entries.sort(key=lambda entry: entry.time_ns)
    findings = Findings.of(book.entries, "", MissionTime(zero_ns=int(0.5 * S), speed=2.0))
    assert (findings.begin_s, findings.end_s) == (1.0, 40.0)
    assert findings.timeline.lanes["a", "client", "Scan"].spans[0].to_s == pytest.approx(2 * 9.52)
    assert findings.moves.moves[0].at_s == pytest.approx(2 * 9.55)


def test_task_from_before_the_recording_is_found(book):
    book.see(5.0, "a", "a/client/Share", Pose(0.0, 0.0, 0.0), "pose", fence=Fence("a/Share", (2, "b")))
    book.see(6.0, "a", "a/device/ir", Pose(0.0, 0.0, 0.0), "pose", fence=Fence("a/ir", (0, "a")))
    book.see(9.0, "a", "a/client/Share", Pose(0.0, 0.0, 0.0), "pose", fence=Fence("a/Share", (2, "b")))
    (lane,) = book.find().timeline.lanes.values()
    assert (lane.task_id, lane.spans[0].to_s, lane.spans[0].epoch) == ("a/Share", 9.0, 2)


def test_migration_has_its_ledger_and_times(book):
    move(book)
    (found,) = book.find().moves.moves
    assert found.goes(SCAN, "a", "b") and found.ledger.outcome == "moved"
    assert [(it.peer, it.fate, it.cost, it.reason) for it in found.ledger.lines] == [
        ("b", "won", 1.0, ""),
        ("c", "refused", None, "lacks motors"),
    ]
    assert found.started_s - found.frozen_s == pytest.approx(0.03)
    assert found.silence_s == pytest.approx(0.2)


def test_migration_is_found_in_either_order(book):
    move(book)
    late = next(entry for entry in book.entries if entry.packet.source == "b/client")
    book.entries.remove(late)
    book.arrive(10.08, "b", late.packet)
    (found,) = book.find().moves.moves
    assert found.started_s - found.frozen_s == pytest.approx(0.08)


def test_paths_come_from_world_poses_and_commands(book):
    for t_s in (0.0, 1.0, 2.0):
        robot = BodyState("a", "robot", t_s, 0.0, 0.0, 0.1, 0.0)
        book.see(t_s, "world", "world/client/World", WorldState(t_s, (robot,)), "world_state")
        book.see(t_s, "a", "a/device/pose", Pose(t_s + 0.01, 0.0, 0.0), "pose")
        book.see(t_s, "b", "b/device/pose", Pose(5.0, t_s, 0.0), "pose")
        book.see(t_s, "b", "a/client/Share", Pose(9.0, 9.0, 0.0), "pose")  # what another tells is not b's own
    book.see(0.5, "a", "a/client/Scan", Twist(0.1, 0.0), "motors", "ctrl")
    book.see(1.5, "a", "a/client/GoHome", Twist(0.1, 0.0), "motors", "ctrl")
    book.see(1.6, "a", "a/device", Hold("done"), "hold", "ctrl")
    paths = book.find().paths
    assert {body.name: body.kind for body in paths.bodies()} == {"a": "robot", "b": "agent"}
    assert [point[1] for point in paths.truth["a"].path.whole()] == [0.0, 1.0, 2.0]
    assert [point[2] for point in paths.poses["b"].path.whole()] == [0.0, 1.0, 2.0]
    assert [(it.task, it.from_s) for it in paths.commands["a"]] == [("Scan", 0.5), ("GoHome", 1.5)]


def test_batteries_are_of_own_devices(book):
    book.see(0.0, "a", "a/device/battery", Battery(7.0, 0.9), "battery")
    book.see(1.0, "b", "a/device/battery", Battery(7.0, 0.9), "battery")
    assert list(book.find().paths.batteries) == ["a"]


def figures(mission_s, ticks, late_s, rate_hz=10.0, missed=0, incarnation=1, dropped=0):
    timer = TimerFigures("tick", rate_hz, ticks, missed, late_s, 0.5)
    link = OneLink("b", 0.002, 7, 700, 3, 300, 0)
    return TaskFigures(mission_s, (OneTask("client/T", "a/T", incarnation, 0, dropped, (timer,)),), (link,), 4, 5)


def sample(book, t_s, body):
    book.see(t_s, "a", "a/log/Recorder", body, "task_figures", "recording")


def test_rates_lateness_and_drops_come_from_samples(book):
    sample(book, 0.0, figures(100.0, 1000, 5.0, dropped=2))
    sample(book, 1.0, figures(105.0, 1045, 5.9, missed=5, dropped=6))
    sample(book, 2.0, figures(110.0, 1095, 6.4, missed=5, dropped=6))
    rates = book.find().rates
    (timer,) = rates.timers.values()
    assert (timer.ticks, timer.missed) == (95, 5)
    assert timer.at[0].asked_hz == 10.0
    assert timer.at[0].achieved_hz == pytest.approx(9.5)
    assert timer.lateness_mean_s == pytest.approx(1.4 / 95)
    assert [point[1] for point in timer.lateness.kept] == [pytest.approx(0.02), pytest.approx(0.01)]
    assert rates.drops["a", "client/T"].total == 4
    assert rates.links["a", "b"].bytes_out == 700
    assert (rates.undelivered["a"], rates.dead_letters["a"]) == (4, 5)


def test_restart_or_new_rate_counts_from_zero(book):
    sample(book, 0.0, figures(0.0, 100, 1.0))
    sample(book, 1.0, figures(1.0, 5, 0.05, incarnation=2))
    sample(book, 2.0, figures(2.0, 9, 0.09, rate_hz=2.0, incarnation=2))
    sample(book, 3.0, figures(4.0, 13, 0.13, rate_hz=2.0, incarnation=2))
    (timer,) = book.find().rates.timers.values()
    assert timer.ticks == 13
    # The achieved rate is unknown for a second with a restart or a change of rate.
    assert [(at.asked_hz, at.ticks, at.achieved_hz) for at in timer.at] == [(2.0, 4, 2.0)]


def test_traffic_counts_at_the_receiver_or_sender(book):
    to_b = book.see(0.0, "a", "a/client/T", Pose(0.0, 0.0, 0.0), "pose", to="b")
    book.arrive(0.01, "b", to_b)
    book.see(0.1, "a", "a/client/T", Pose(0.0, 0.0, 0.0), "pose", to="elsewhere/client/X")
    around = book.see(0.2, "a", "a/client/T", Pose(0.0, 0.0, 0.0), "pose", to="*")
    book.arrive(0.21, "b", around)
    book.see(0.3, "a", "a/client/T", Pose(0.0, 0.0, 0.0), "pose")  # stays
    traffic = book.find().traffic
    counted = {name: traffic.links.packets.total(name) for name in traffic.links.names()}
    assert counted == {"a → b": 2, "a → elsewhere": 1}
    assert traffic.links.bytes.total("a → b") > 40
    assert traffic.channels.packets.total("system") == 3


def test_traffic_of_a_single_recorded_agent(book):
    book.see(0.2, "a", "a/client/T", Pose(0.0, 0.0, 0.0), "pose", to="*")
    assert book.find().traffic.links.names() == ["a → *"]


def react(book, t_s, late_s):
    """Record a pose from the world, and a command in answer to it."""
    seen = book.see(t_s, "world", "world/client/Mocap", Pose(0.0, 0.0, 0.0), "pose", to="a")
    book.arrive(t_s + 0.004, "a", seen)
    cause = (seen.source, seen.seq)
    read = book.see(t_s + 0.005, "a", "a/device/pose", Pose(0.0, 0.0, 0.0), "pose", cause=cause)
    cause, fence = (read.source, read.seq), Fence(SCAN, (0, "a"))
    body = Twist(0.1, 0.0)
    book.see(t_s + 0.005 + late_s, "a", "a/client/Scan", body, "motors", "ctrl", cause=cause, fence=fence)


def test_commands_have_chains_with_times(book):
    for number in range(100):
        react(book, float(number), 0.001 * (number + 1))
    book.see(200.0, "a", "a/client/Scan", Twist(0.0, 0.0), "motors", "ctrl")
    found = book.find().reactions
    assert (found.commands, found.uncaused) == (101, 1)
    (reaction,) = found.reactions()
    assert reaction.steps == ("world/client/Mocap pose", "a/device/pose pose", "a/client/Scan motors")
    assert reaction.count == 100
    assert reaction.step_means_s == [pytest.approx(0.005), pytest.approx(0.0505)]
    assert reaction.travel_means_s == [pytest.approx(0.004), 0.0]
    assert reaction.latency_s.quantile(0.5) == pytest.approx(0.056)
    assert reaction.latency_s.quantile(0.99) == pytest.approx(0.105)


def test_report_on_one_task_leaves_out_others(book):
    move(book)
    react(book, 30.0, 0.001)
    book.see(31.0, "a", "a/client/Other", Twist(0.0, 0.0), "motors", "ctrl", fence=Fence("a/Other", (0, "a")))
    found = book.find(SCAN)
    assert {lane.task for lane in found.timeline.lanes.values()} == {"Scan"}
    assert found.reactions.commands == 4
    assert len(found.moves.moves) == 1
    assert book.find("a/Other").moves.moves == []


def test_digest_counts_equal_entries(book):
    for t_s in (1.0, 2.0, 3.0):
        book.see(t_s, "a", "a/client/T", LogLine("warning", "slow"), "line", "log")
    book.see(1.5, "a", "a/client/T", LogLine("info", "nothing"), "line", "log")
    book.event(2.5, "a", "task_failed", task="T", error="ValueError: no")
    book.event(2.6, "a", "revolution", count=3)
    said = book.find().events
    assert [(it.kind, it.text, it.count) for it in said.grave] == [
        ("warning", "slow", 3),
        ("task_failed", "task T, error ValueError: no", 1),
    ]
    assert [(it.kind, it.text) for it in said.events] == [("revolution", "count 3")]


def test_malformed_packet_is_counted_and_skipped(book):
    book.see(0.0, "a", "a/device/battery", {"volts": 7}, "battery")
    book.see(1.0, "a", "a/device/battery", Battery(7.0, 0.5), "battery")
    found = book.find()
    assert (found.strange, found.packets) == (1, 2)
    assert found.paths.batteries["a"].last == (1.0, 0.5)


def test_findings_need_no_matplotlib(book, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    move(book)
    assert book.find().plain()["moves"][0]["winner"] == "b"


def test_long_time_series_is_thinned():
    series = TimeSeries()
    for number in range(50_000):
        series.add(float(number), number)
    assert MOST_POINTS / 2 <= len(series.kept) <= MOST_POINTS
    assert series.whole()[-1] == (49_999.0, 49_999)
    gaps = {later[0] - earlier[0] for earlier, later in pairwise(series.kept)}
    assert len(gaps) == 1  # thinned out evenly


def test_counts_keep_their_sum_with_longer_slots():
    counts = Counts()
    for second in range(10 * MOST_SLOTS):
        counts.add(float(second), "x", 2.0)
    assert counts.total("x") == 20.0 * MOST_SLOTS
    assert len(counts.slots["x"]) <= MOST_SLOTS
    assert {rate for _, rate in counts.rates("x", 10.0 * MOST_SLOTS)} == {2.0}


def test_large_sample_keeps_its_distribution():
    sample = Distribution()
    for number in range(100_000):
        sample.add(float(number % 1000))
    assert sample.count == 100_000
    assert sample.largest == 999.0
    assert sample.quantile(0.9) == pytest.approx(900.0, abs=30.0)
