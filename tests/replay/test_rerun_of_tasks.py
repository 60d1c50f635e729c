"""Reruns of recorded tasks: an unchanged task agrees with its recording, and changes show."""

import threading
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray
from recording.files import made_files
from replay.runs_again import recorded, run_again
from services.asking import Asker, Driver, Go

from pancakes.control import Configure, Describe, Migrate, Reply, Reschedule, Restart, Start, Stop
from pancakes.devices import Load, Pose, Temperature
from pancakes.errors import PancakesError
from pancakes.packet import task_address
from pancakes.recording.reader import RecordingReader
from pancakes.recording.records import RecordingError
from pancakes.simulation.fleet import registered
from pancakes.task import Task, every, on
from pancakes.testing import AgentHandle, Fleet, threaded_agent
from pancakes.tools.replay.comparison import StreamKey
from pancakes.tools.replay.recorded_run import UNKNOWN_TICKS, choose_stays, find_stays
from pancakes.tools.replay.rerun import class_of


class Track(Task):
    """Sums the values that it receives, publishes the sum in each tick, and answers each pose."""

    @dataclass
    class Settings:
        gain: float = 2.0
        table: dict[str, int] = field(default_factory=dict)

    @dataclass
    class State:
        total: float = 0.0
        seen: list[int] = field(default_factory=list)

    def on_start(self):
        self.event("begins", total=self.state.total)

    @on("system", Pose)
    def pose(self, packet):
        self.state.total += packet.body.x_m
        self.state.seen.append(packet.seq)
        self.publish("ctrl", Load(self.settings.gain * packet.body.x_m))

    @every(hz=10)
    def tell(self, tick):
        self.publish("system", Temperature(self.state.total + self.random.random()))

    def on_stop(self):
        self.event("ends", total=self.state.total, heard=len(self.state.seen))


class Steeper(Track):
    """As `Track`, with one line changed: from 2 on it counts twice."""

    @on("system", Pose)
    def pose(self, packet):
        super().pose(packet)
        if packet.body.x_m >= 2.0:
            self.state.total += packet.body.x_m


class Other(Track):
    """As `Track`, but it answers poses otherwise."""

    @on("system", Pose)
    def pose(self, packet):
        self.state.total += packet.body.x_m
        self.publish("ctrl", Load(3.0 * packet.body.x_m))


@pytest.fixture
def fleet():
    with Fleet() as fleet:
        yield fleet


def say(agent, *x_m):
    for value in x_m:
        agent.publish("system", Pose(value, 0.0, 0.0))
        agent.agent.kernel.virtual.run_until(agent.kernel.host.now() + 0.33)


def test_unchanged_task_agrees_with_its_recording(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Track": {"type": Track, "start": False, "settings": {"gain": 1.5}}})
    fleet.run_for(1.234)
    with recorded(tmp_path, agent):
        say(agent, 7.0)
        agent.ask(Start("Track"))
        say(agent, 1.0, 2.0, 3.0)
        agent.ask(Stop("Track"))
        say(agent, 9.0)
    again = run_again(tmp_path, "Track", Track)
    assert again.stay.whole
    assert (again.stay.end, again.comparison.differences) == ("stopped", [])
    counts = {key.type: stream for key, stream in again.comparison.streams.items()}
    assert (counts["load"].equal, counts["event"].equal) == (3, 2)
    assert counts["temperature"].equal >= 9


def test_changed_line_shows_at_the_right_packet(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Track": {"type": Track, "start": False}})
    with recorded(tmp_path, agent):
        agent.ask(Start("Track"))
        say(agent, 1.0, 2.0, 3.0)
    again = run_again(tmp_path, "a/Track", Other)
    (first, *others) = [difference for difference in again.comparison.differences if difference.packet.type == "load"]
    assert len(others) == 2
    assert first.kind == "different"
    assert first.fields == (("cpu", 2.0, 3.0),)
    steeper = run_again(tmp_path, "a/Track", Steeper)
    (second,) = [packet for packet in steeper.script.outputs if packet.type == "load" and packet.body.cpu == 4.0]
    assert min(it.packet.stamp_s for it in steeper.comparison.differences) > second.stamp_s
    assert {it.packet.type for it in steeper.comparison.differences} == {"temperature"}


def test_given_settings_replace_recorded_ones(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Track": {"type": Track, "start": False}})
    with recorded(tmp_path, agent):
        agent.ask(Start("Track"))
        say(agent, 1.0)
    again = run_again(tmp_path, "Track", Track, gain=5.0)
    assert [difference.fields for difference in again.comparison.differences] == [(("cpu", 2.0, 5.0),)]
    with pytest.raises(PancakesError, match="gian: unknown key, did you mean 'gain'"):
        run_again(tmp_path, "Track", Track, gian=5.0)


def test_recorded_changes_are_repeated(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Track": {"type": Track, "start": False}})
    with recorded(tmp_path, agent):
        agent.ask(Start("Track"))
        say(agent, 1.0, 2.0)
        agent.ask(Reschedule("Track", 25.0))
        agent.ask(Configure("Track", {"gain": 10.0}))
        say(agent, 3.0, 4.0)
        agent.ask(Reschedule("Track", 0.0))
        say(agent, 5.0)
    again = run_again(tmp_path, "Track", Track)
    assert again.comparison.differences == []
    assert [packet.body.cpu for packet in again.outcome.outputs if packet.type == "load"] == [
        2.0,
        4.0,
        30.0,
        40.0,
        50.0,
    ]
    other = run_again(tmp_path, "Track", Track, gain=1.0)
    assert [packet.body.cpu for packet in other.outcome.outputs if packet.type == "load"] == [1.0, 2.0, 3.0, 4.0, 5.0]


def test_task_from_before_the_recording_begins_with_its_state(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Track": Track})
    say(agent, 1.0, 2.0, 3.0)
    with recorded(tmp_path, agent):
        fleet.run_for(0.05)
        say(agent, 4.0, 5.0)
    again = run_again(tmp_path, "Track", Track)
    assert not again.stay.whole
    assert again.stay.task.state["total"] == 6.0
    # Its random numbers differ; everything else agrees, and it does not start a second time.
    wrong = [it.packet.type for it in again.comparison.differences]
    assert set(wrong) == {"temperature"}
    assert {it.fields[0].field for it in again.comparison.differences} == {"celsius"}
    assert again.comparison.streams[StreamKey("ctrl", "load", "")].equal == 2


def test_tasks_that_start_with_their_agent_are_whole(fleet, tmp_path):
    agent = fleet.start("a", f'[record]\npath = "{tmp_path}/{{agent}}.mcap"\n', tasks={"Track": Track, "Other": Other})
    say(agent, 1.0, 2.0)
    agent.ask(Stop("log/Recorder"))
    for name, cls in (("Track", Track), ("Other", Other)):
        again = run_again(tmp_path, name, cls)
        assert again.stay.whole
        assert again.comparison.differences == []
        assert again.comparison.streams[StreamKey("ctrl", "load", "")].equal == 2


def test_restarted_task_begins_with_its_carried_state(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Track": {"type": Track, "start": False}})
    with recorded(tmp_path, agent):
        agent.ask(Start("Track"))
        say(agent, 1.0, 2.0)
        agent.ask(Restart("Track"))
        say(agent, 3.0)
        agent.ask(Stop("Track"))
        fleet.run_for(0.1)
    assert run_again(tmp_path, "Track", Track, number=1).comparison.differences == []
    again = run_again(tmp_path, "Track", Track, number=2)
    assert again.stay.task.began is not None
    began = again.stay.task.began["state"]
    assert (began["total"], len(began["seen"])) == (3.0, 2)
    numbers = [packet.seq for packet in again.outcome.outputs]
    assert numbers == [packet.seq for packet in again.script.outputs]
    assert numbers[0] > 1
    assert again.comparison.differences == []
    (end,) = [packet.body for packet in again.outcome.outputs if packet.type == "event" and packet.body.kind == "ends"]
    assert end.fields == {"total": 6.0, "heard": 3}


def test_each_stay_of_a_migrating_task_is_rerun(fleet, tmp_path):
    a, b = fleet.start("a", tasks={"Track": Track}), fleet.start("b")
    fleet.connect()
    with recorded(tmp_path, a, b):
        say(a, 1.0, 2.0)
        assert a.ask(Migrate("Track", to="b")).ok
        say(b, 3.0)
        say(a, 100.0)
    assert [stay.agent for stay in choose_stays(find_stays(RecordingReader(tmp_path).entries()), "Track")] == ["a", "b"]
    here, there = (run_again(tmp_path, "Track", Track, agent=agent) for agent in "ab")
    assert {it.packet.type for it in here.comparison.differences} <= {"temperature"}  # it was not seen to start
    assert there.comparison.differences == []
    begins = [packet.body.fields["total"] for packet in there.outcome.outputs if packet.type == "event"]
    assert begins == [3.0]
    assert run_again(tmp_path, "Track", Track, number=2).stay.agent == "b"


class Asks(Task):
    """Asks its agent for its tasks, and publishes their number. `twice`: asks another question before."""

    @dataclass
    class Settings:
        twice: bool = False

    def on_start(self):
        self._asked = set()

    @every(hz=2)
    def ask_now(self, tick):
        if self.settings.twice:
            self.publish("sysctrl", Describe("log/"))
        self._asked.add(self.publish("sysctrl", Describe("client/")).seq)

    @on("sysctrl", Reply, addressed=True)
    def take(self, packet):
        if packet.cause[1] in self._asked:
            self.publish("system", Load(float(len(packet.body.result))))


def test_answers_are_matched_to_renumbered_questions(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Asks": {"type": Asks, "start": False}})
    with recorded(tmp_path, agent):
        agent.ask(Start("Asks"))
        fleet.run_for(2.0)
    assert run_again(tmp_path, "Asks", Asks).comparison.differences == []
    again = run_again(tmp_path, "Asks", Asks, twice=True)
    counts = {(key.type): stream for key, stream in again.comparison.streams.items() if key.type == "load"}
    assert counts["load"].equal == counts["load"].recorded >= 3


@pytest.mark.parametrize("to", ["task:a/Driver", "a/client/Driver"])
@pytest.mark.parametrize("task", [Asker, Driver])
def test_requests_and_their_answers_come_again(fleet, tmp_path, task, to):
    tasks = {cls.__name__: {"type": cls, "start": False} for cls in (Asker, Driver)}
    agent = fleet.start("a", tasks=tasks)
    with recorded(tmp_path, agent):
        assert agent.ask(Start("Driver")).ok and agent.ask(Start("Asker")).ok
        fleet.run_for(0.5)
        agent.publish("system", Go("Drive", to, 3), to="a/client/Asker")
        fleet.run_for(6.0)
    again = run_again(tmp_path, task.__name__, task)
    assert again.comparison.differences == [] and len(again.outcome.outputs) >= 1


class Hears(Task):
    """Publishes the letters that it gets."""

    @on("system", Load, addressed=True)
    def heard(self, packet):
        self.publish("system", Temperature(packet.body.cpu))


class Writes(Task):
    """Writes letters to a task, on any agent."""

    @every(hz=4)
    def write(self, tick):
        self.publish("system", Load(tick.time_s), to=task_address("b/Hears"))


class WritesToA(Writes):
    """Writes to a task that was born on `a`."""

    @every(hz=4)
    def write(self, tick):
        self.publish("system", Load(tick.time_s), to=task_address("a/Hears"))


@pytest.mark.parametrize("writer", ["a", "b"])
def test_letters_are_inputs_once_each(fleet, tmp_path, writer):
    a, b = fleet.start("a"), fleet.start("b", tasks={"Hears": {"type": Hears, "start": False}})
    fleet.connect()
    with recorded(tmp_path, a, b):
        b.ask(Start("Hears"))
        {"a": a, "b": b}[writer].agent.kernel.spawn(Writes, f"{writer}/test/Writes")
        fleet.run_for(3.0)
    again = run_again(tmp_path, "Hears", Hears)
    assert again.comparison.streams[StreamKey("system", "temperature", "")].equal >= 10
    assert again.comparison.differences == []


def test_recording_of_one_task_can_be_rerun(fleet, tmp_path):
    a, b = fleet.start("a", tasks={"Hears": {"type": Hears, "start": False}}), fleet.start("b")
    fleet.connect()
    for agent in (a, b):
        assert agent.ask(Start("log/Recorder", {"path": str(tmp_path / "{agent}.mcap"), "task": "a/Hears"})).ok
    a.ask(Start("Hears"))
    b.agent.kernel.spawn(WritesToA, "b/test/Writes")
    say(a, 1.0)
    fleet.run_for(2.0)
    assert a.ask(Migrate("Hears", to="b")).ok
    fleet.run_for(2.0)
    for agent in (a, b):
        agent.ask(Stop("log/Recorder"))
    assert "pose" not in {entry.packet.type for entry in RecordingReader(tmp_path).entries()}
    for agent in "ab":
        again = run_again(tmp_path, "Hears", Hears, agent=agent)
        assert again.stay.whole
        assert again.comparison.streams[StreamKey("system", "temperature", "")].equal >= 6
        assert again.comparison.differences == []


class Newest(Task):
    """Wants only the newest pose."""

    @on("system", Pose, queue="latest")
    def pose(self, packet):
        self.publish("ctrl", Load(packet.body.x_m))


def test_a_packet_dropped_from_the_mailbox_then_is_dropped_now(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Newest": {"type": Newest, "start": False}})
    with recorded(tmp_path, agent):
        agent.ask(Start("Newest"))
        agent.publish("system", Pose(1.0, 0.0, 0.0))
        agent.publish("system", Pose(2.0, 0.0, 0.0))
        fleet.run_for(1.0)
        say(agent, 3.0)
    again = run_again(tmp_path, "Newest", Newest)
    assert again.script.superseded == 1
    assert [packet.body.cpu for packet in again.outcome.outputs] == [2.0, 3.0]
    assert again.comparison.differences == []


class Fails(Task):
    """Fails at a pose behind the origin."""

    def pose_is_good(self, pose):
        return pose.x_m >= 0.0

    @on("system", Pose)
    def pose(self, packet):
        if not self.pose_is_good(packet.body):
            raise ValueError("behind the origin")
        self.publish("ctrl", Load(packet.body.x_m))


class Mended(Fails):
    """Does not fail."""

    def pose_is_good(self, pose):
        return True


def test_failure_is_repeated_until_fixed(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Fails": {"type": Fails, "start": False}})
    with recorded(tmp_path, agent):
        agent.ask(Start("Fails"))
        say(agent, 1.0, -1.0, 2.0)
    stays = choose_stays(find_stays(RecordingReader(tmp_path).entries()), "Fails")
    assert [stay.end for stay in stays] == ["failed", ""]
    assert stays[0].reason.startswith("ValueError: behind the origin")
    again = run_again(tmp_path, "Fails", Fails, number=1)
    assert again.outcome.failed == stays[0].reason
    mended = run_again(tmp_path, "Fails", Mended, number=1)
    assert mended.outcome.failed == ""
    # Now it answers the pose at which it failed then.
    assert mended.kinds == ["extra"]
    assert run_again(tmp_path, "Fails", Fails, number=2).comparison.differences == []


def test_two_recordings_of_one_run_are_two_stays(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Track": Track})
    with recorded(tmp_path, agent):
        fleet.run_for(0.05)
        say(agent, 1.0)
    say(agent, 2.0)
    with recorded(tmp_path, agent):
        fleet.run_for(0.05)
        say(agent, 3.0)
    for number in (1, 2):
        again = run_again(tmp_path, "Track", Track, number=number)
        assert again.comparison.streams[StreamKey("ctrl", "load", "")].equal == 1
        assert set(again.kinds) <= {"different"}  # the random numbers


def test_unfit_state_and_missing_class_are_errors(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Track": Track})
    say(agent, 1.0)
    with recorded(tmp_path, agent):
        say(agent, 2.0)

    class Renamed(Track):
        @dataclass
        class State:
            sum: float = 0.0

    with pytest.raises(
        RecordingError, match=r"a/Track cannot start with the recorded settings and state: .*total: unknown key"
    ):
        run_again(tmp_path, "Track", Renamed)
    (stay,) = choose_stays(find_stays(RecordingReader(tmp_path).entries()), "Track")
    assert class_of(stay, registered({"test.Track": Track})) is Track
    with pytest.raises(RecordingError, match=r"a/Track cannot be rerun: .*test\.Track"):
        class_of(stay, registered({}))


def wait_for(agent: AgentHandle, cls: type, count: int) -> None:
    agent.wait_until(lambda: len(agent.probe.packets(cls)) >= count)


def test_rerun_of_task_on_threads_agrees(tmp_path):
    """Even on a slow host, where a tick may be missed, or due while the task starts or ends."""
    with threaded_agent("a", tasks={"Track": {"type": Track, "start": False}}) as agent:
        with recorded(tmp_path, agent):
            agent.ask(Start("Track"))
            for number in range(1, 6):
                agent.publish("system", Pose(float(number), 0.0, 0.0))
                wait_for(agent, Load, number)
                wait_for(agent, Temperature, len(agent.probe.packets(Temperature)) + 1)
            agent.ask(Stop("Track"))
    again = run_again(tmp_path, "Track", Track, live=True)
    assert again.comparison.streams[StreamKey("ctrl", "load", "")].equal == 5
    assert again.comparison.streams[StreamKey("system", "temperature", "")].recorded >= 5
    assert again.comparison.differences == []
    changed = run_again(tmp_path, "Track", Other, live=True)
    assert changed.comparison.streams[StreamKey("ctrl", "load", "")].different == 5


class Dawdles(Track):
    """Is so slow to start, handle a pose and end that ticks of 10 Hz become due; live only. Counts missed ticks."""

    def dawdle(self):
        if self._actor.kernel.virtual is None:
            passed = threading.Event()
            self._actor.kernel.timer.after(0.35, passed.set)
            assert passed.wait(60.0)

    def on_start(self):
        self.dawdle()

    @on("system", Pose)
    def pose(self, packet):
        self.dawdle()
        super().pose(packet)

    @every(hz=10)
    def tell(self, tick):
        self.publish("system", Temperature(self.state.total + tick.missed))

    def on_stop(self):
        self.dawdle()


@pytest.mark.parametrize("stops", [True, False])
def test_rerun_leaves_out_missed_ticks(tmp_path, stops):
    """Both if the task ends before the recording, and if it runs on."""
    with threaded_agent("a", tasks={"Dawdles": {"type": Dawdles, "start": False}}) as agent:
        with recorded(tmp_path, agent):
            agent.ask(Start("Dawdles"))
            wait_for(agent, Temperature, 1)
            agent.publish("system", Pose(10.0, 0.0, 0.0))
            wait_for(agent, Load, 1)
            wait_for(agent, Temperature, len(agent.probe.packets(Temperature)) + 1)
            if stops:
                agent.ask(Stop("Dawdles"))
    again = run_again(tmp_path, "Dawdles", Dawdles, live=True)
    counts = again.comparison.streams[StreamKey("system", "temperature", "")]
    assert max(packet.body.celsius % 10.0 for packet in again.outcome.outputs if packet.type == "temperature") >= 2.0
    assert (again.kinds, again.script.notes, again.stay.end) == ([], [], "stopped" if stops else "")
    assert counts.equal == counts.recorded >= 3
    older = run_again(tmp_path, "Dawdles", Dawdles, live=True, without="task_ticks")
    assert "extra" in older.kinds and older.script.notes == [UNKNOWN_TICKS]


def test_stays_before_and_after_a_kill_are_rerun(tmp_path, monkeypatch):
    made = made_files(monkeypatch)
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Track": {"type": Track, "durability": "each"}})
        assert agent.ask(Start("log/Recorder", {"path": str(tmp_path / "a.mcap")})).ok
        for x_m in (1.0, 2.0, 3.0):
            agent.publish("system", Pose(x_m, 0.0, 0.0))
            fleet.run_for(1.0)
        fleet.crash("a")
        made[-1].raw.close()  # as the operating system does
        agent = fleet.restart("a")
        agent.publish("system", Pose(4.0, 0.0, 0.0))
        fleet.run_for(2.0)
        assert agent.ask(Stop("log/Recorder")).ok
    first, second = (run_again(tmp_path, "Track", Track, number=number) for number in (1, 2))
    assert (first.kinds, second.kinds) == ([], [])
    assert (first.stay.end, first.stay.whole, second.stay.whole) == ("", False, True)
    assert second.stay.begins_s < 0.1  # its mission time began anew
    assert len(first.outcome.outputs) > 20
    assert len(second.outcome.outputs) == pytest.approx(22, abs=1)
    steeper = run_again(tmp_path, "Track", Steeper, number=2)
    assert steeper.kinds != []


class Weighs(Task):
    """Keeps arrays in its settings and in its state."""

    @dataclass
    class Settings:
        gains: np.ndarray = field(default_factory=lambda: np.ones(2))

    @dataclass
    class State:
        grid: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((2, 2), np.uint8))

    @on("system", Pose)
    def pose(self, packet):
        self.state.grid[0, 1] += 10
        self.publish("ctrl", Load(float(self.settings.gains.sum() * self.state.grid.sum())))


def test_rerun_restores_arrays(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Weighs": {"type": Weighs, "settings": {"gains": [1, 2]}}})
    say(agent, 1.0, 1.0)
    assert agent.ask(Configure("Weighs", {"gains": np.array([2.0, 3.0])})).ok
    with recorded(tmp_path, agent):
        say(agent, 1.0)
        assert agent.ask(Configure("Weighs", {"gains": np.array([1.0, 1.0])})).ok
        say(agent, 1.0)
    again = run_again(tmp_path, "Weighs", Weighs)
    assert again.comparison.differences == []
    loads = [packet.body.cpu for packet in again.outcome.outputs if isinstance(packet.body, Load)]
    assert loads == [150.0, 80.0]
