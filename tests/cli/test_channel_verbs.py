"""`pancakes channel ...`: the users of channels of running agents, and the packets on them."""

import json
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import pytest
from cli.live_output import LiveOutput
from cli.processes import Rig, Running
from devices.jpegs import jpeg

from pancakes.devices import CameraFrame, Pose
from pancakes.packet import Packet
from pancakes.tools.cli.verbs.channel import record_of, size_of, text_of

SOURCE = """
from pancakes.devices import Battery, Pose, Sonar
from pancakes.task import Task, every, on

class Walk(Task):
    @every(hz=50)
    def step(self, tick):
        self.publish("pond", Pose(1.0, 2.0, 0.5))

    @every(hz=10)
    def look(self, tick):
        self.publish("pond", Sonar((0.0, 1.0), (0.25, 0.75), 2.0))

class Watch(Task):
    @on("pond", Battery)
    def see(self, packet):
        self.event("saw", level=packet.body.level, by=packet.source, stamp=packet.stamp_s)
"""
ENTRY_POINTS = "[pancakes.tasks]\nwalk.Walk = plugin_walk:Walk\nwalk.Watch = plugin_walk:Watch\n"
TASKS = '[channel.pond]\n[channel.dry]\n[task.Walk]\ntype = "walk.Walk"\n[task.Watch]\ntype = "walk.Watch"\n'

Start = Callable[..., LiveOutput]


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Rig, Running]]:
    """An agent that no test changes."""
    with closing(Rig(tmp_path_factory.mktemp("shared"))) as rig:
        rig.install("walk", ENTRY_POINTS, SOURCE)
        yield rig, rig.ready("a", TASKS)


@pytest.fixture
def agent(rig: Rig) -> Running:
    """An agent for one test."""
    rig.install("walk", ENTRY_POINTS, SOURCE)
    return rig.ready("a", TASKS)


def rows_of(rig: Rig, *arguments: str) -> list[dict[str, Any]]:
    return rig.listed("channel", *arguments)


def full(level: float) -> str:
    return json.dumps({"voltage_v": 7.4, "level": level})


def near(hz: float) -> Any:
    """Return the expected measured rate of a task: a busy machine may miss ticks, but never adds any."""
    return pytest.approx(0.625 * hz, rel=0.8)  # from 1/8 to 9/8


def test_channel_list_and_info_show_subscribers_and_publishers(shared: tuple[Rig, Running]):
    rig, _ = shared
    row = next(row for row in rows_of(rig, "list", "a") if row["channel"] == "pond")
    assert (row["agent"], row["core"], row["subscribers"], row["waiting"], row["dropped"]) == ("a", False, 1, 0, 0)

    with closing(LiveOutput(rig, "channel", "echo", "a/pond")) as echo:
        echo.line("pose")
        (row,) = rows_of(rig, "info", "a/pond")
    (reader,) = row["subscribers"]
    assert (reader["address"], reader["types"], reader["limit"]) == ("a/client/Watch", ["battery"], 256)
    assert len(row["followers"]) == 1, "the other command, and not this one"
    sonar, pose = sorted(row["publishers"], key=lambda it: it["packets"])
    assert (sonar["source"], sonar["type"], pose["type"]) == ("a/client/Walk", "sonar", "pose")
    assert (pose["rate_hz"], sonar["rate_hz"]) == (near(50.0), near(10.0))

    text = rig.pancakes("channel", "info", "a/dry", "--for", "100ms").stdout
    for part in ("No component of this agent", "Followed from elsewhere by none", "No packet was published"):
        assert part in text


def test_missing_channel_is_refused_by_each_verb(shared: tuple[Rig, Running]):
    rig, _ = shared
    body = ("battery", full(0.5))
    for verb in (("info", "a/lake", "--for", "1s"), ("echo", "a/lake"), ("hz", "a/lake"), ("pub", "a/lake", *body)):
        result = rig.pancakes("channel", *verb)
        assert (result.returncode, result.stdout) == (1, ""), verb
        assert result.stderr.startswith("a has no channel 'lake', only "), verb


# echo ----------------------------------------------------------------------------------------------------------------


def test_channel_echo_prints_json_and_yaml(shared: tuple[Rig, Running]):
    rig, _ = shared
    first, second, third = rows_of(rig, "echo", "a/pond", "--type", "pose", "--from", "a/client", "--count", "3")
    assert first["seq"] < second["seq"] < third["seq"]
    expected = {"agent": "a", "channel": "pond", "type": "pose", "source": "a/client/Walk"}
    assert {key: first[key] for key in expected} == expected
    assert first["body"] == {"x_m": 1.0, "y_m": 2.0, "theta_rad": 0.5}

    lines = rig.pancakes("channel", "echo", "a/pond", "--type", "sonar", "--count", "1").stdout.splitlines()
    assert lines[:2] == ["type: sonar", "source: a/client/Walk"]
    assert lines[4:] == ["body:", "  bearings_rad: [0.0,1.0]", "  ranges_m: [0.25,0.75]", "  max_range_m: 2", "---"]


def test_channel_echo_selects_fields_types_and_sources(shared: tuple[Rig, Running]):
    rig, _ = shared
    fields = ("--field", "ranges_m.1", "--field", "packet.type")
    result = rig.pancakes("channel", "echo", "a/pond", *fields, "--count", "2")
    assert result.stdout == "0.75\tsonar\n" * 2
    assert result.stderr.startswith("packets of the type pose are skipped: they have no ranges_m.1")
    # With --type the class is known here, and its fields are tuples instead of lists.
    of_a_type = rows_of(rig, "echo", "a/pond", "--type", "sonar", "--field", "ranges_m.1", "--count", "1")
    assert of_a_type == [{"ranges_m.1": 0.75}]

    unknown = rig.pancakes("channel", "echo", "a/pond", "--type", "posse", "--for", "100ms", "--format", "json")
    assert (unknown.returncode, json.loads(unknown.stdout)) == (0, [])
    assert "did you mean 'pose'?" in unknown.stderr
    assert rows_of(rig, "echo", "a/pond", "--from", "a/client/Wal", "--from", "alice", "--for", "500ms") == []


def test_channel_echo_runs_until_ctrl_c(shared: tuple[Rig, Running]):
    rig, _ = shared
    with closing(LiveOutput(rig, "channel", "echo", "a/pond", "--format", "json")) as echo:
        assert echo.record("pose")["body"]["x_m"] == 1.0
        assert echo.record("sonar")["type"] == "sonar"
        assert (echo.interrupt(), echo.said) == (0, [])

    counted = ("channel", "echo", "a/pond", "--count", "1000000", "--format", "json")
    with closing(LiveOutput(rig, *counted)) as echo:
        echo.line("pose")
        assert echo.interrupt() == 0
        assert len(json.loads("\n".join(echo.printed))) >= 1


HEAD = """
import subprocess, sys
for chosen in ("table", "json"):
    command = [sys.executable, "-m", "pancakes.tools.cli.main", "channel", "echo", "a/pond", "--format", chosen]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as echo:
        echo.stdout.readline()
        echo.stdout.close()
        print(echo.wait(20.0), repr(echo.stderr.read()))
"""


def test_channel_echo_ends_with_its_reader(shared: tuple[Rig, Running]):
    rig, _ = shared
    assert rig.run("-c", HEAD, whole=True).everything() == "0 ''\n0 ''"


def test_channel_echo_follows_an_agent_that_comes_back(rig: Rig, agent: Running, start: Start):
    echo = start("channel", "echo", "a/pond", "--type", "pose", "--field", "packet.seq")
    echo.line()
    assert rig.pancakes("service", "restart", "a/network").returncode == 0
    (now,) = rows_of(rig, "echo", "a/pond", "--type", "pose", "--count", "1")
    while int(echo.line()) <= now["seq"]:
        pass

    agent.process.kill()
    echo.hear("a is away: waiting for it to come back")
    last = int(echo.last())
    rig.ready("a", TASKS)
    echo.hear("a is here")
    assert int(echo.line()) != last
    assert echo.interrupt() == 0


def test_channel_echo_of_a_lost_agent_exits_with_3(agent: Running, start: Start):
    forever = start("channel", "echo", "a/pond")
    counts = start("channel", "echo", "a/pond", "--count", "1000000", "--timeout", "0.5")
    ends_late = start("channel", "echo", "a/pond", "--for", "2500ms")
    for it in (forever, counts, ends_late):
        it.line()
    agent.process.kill()

    assert (counts.ended(), counts.said[-1]) == (3, "a did not come back within 0.5 s")
    assert (ends_late.ended(), ends_late.said[-1]) == (3, "a went away and did not come back")
    forever.hear("a is away")
    assert forever.interrupt() == 0


# hz, bw --------------------------------------------------------------------------------------------------------------


def test_channel_hz_measures_each_source_and_type(shared: tuple[Rig, Running]):
    rig, _ = shared
    pose, sonar = rows_of(rig, "hz", "a/pond", "--for", "1s")
    assert list(pose) == ["source", "type", "rate_hz", "min_s", "max_s", "std_dev_s", "window"]
    assert (pose["type"], sonar["type"]) == ("pose", "sonar")
    assert (pose["rate_hz"], sonar["rate_hz"]) == (near(50.0), near(10.0))
    assert pose["min_s"] <= 0.02 <= pose["max_s"]
    (counted,) = rows_of(rig, "hz", "a/pond", "--type", "pose", "--count", "20")
    assert counted["window"] == 20
    silent = rig.pancakes("channel", "hz", "a/dry", "--for", "100ms")
    assert (silent.returncode, silent.stdout, silent.stderr) == (0, "", "no new packet on a/dry\n")

    with closing(LiveOutput(rig, "channel", "hz", "a/pond", "--type", "pose", "--format", "json")) as hz:
        first, second = hz.record(), hz.record()
        assert first["rate_hz"] == near(50.0)
        assert 6 <= second["window"] - first["window"] <= 60, "it reports each second"
        assert hz.interrupt() == 0


def test_channel_hz_uses_mission_time_by_default(rig: Rig):
    rig.install("walk", ENTRY_POINTS, SOURCE)
    rig.ready("fast", TASKS, "--set", "clock.speed=4")
    (mission,) = rows_of(rig, "hz", "fast/pond", "--type", "sonar", "--for", "1s")
    (host,) = rows_of(rig, "hz", "fast/pond", "--type", "sonar", "--for", "1s", "--wall-time")
    assert (mission["rate_hz"], host["rate_hz"]) == (near(10.0), near(40.0))


def test_channel_bw_counts_bytes_on_the_wire(shared: tuple[Rig, Running]):
    rig, _ = shared
    pose, sonar, whole = rows_of(rig, "bw", "a/pond", "--for", "1s")
    size = size_of(Packet("pond", "pose", "a/client/Walk", "", 1.5, 100, Pose(1.0, 2.0, 0.5)))
    assert pose["mean_bytes"] == pytest.approx(size, abs=25)  # numbers grow, and there is the tick that caused it
    assert pose["bytes_per_s"] == near(50.0 * pose["mean_bytes"])
    assert (whole["source"], whole["type"]) == ("all", "all")
    assert whole["bytes_per_s"] == pytest.approx(pose["bytes_per_s"] + sonar["bytes_per_s"])
    assert whole["window"] == pose["window"] + sonar["window"]

    result = rig.pancakes("channel", "bw", "a/pond", "--type", "pose", "--count", "5", "--window", "3")
    head, _, row = (line.split() for line in result.stdout.splitlines() if line.strip())
    assert head == ["source", "type", "bytes_per_s", "min_bytes", "mean_bytes", "max_bytes", "window"]
    assert (row[0], row[-1]) == ("a/client/Walk", "3")


# pub -----------------------------------------------------------------------------------------------------------------


def test_channel_pub_reaches_subscribers(shared: tuple[Rig, Running]):
    rig, agent = shared
    (dry,) = rows_of(rig, "pub", "a/pond", "battery", full(0.5), "--dry-run")
    assert (dry["packets"], dry["subscribers"]) == (0, ["a/client/Watch"])
    (row,) = rows_of(rig, "pub", "a/pond", "battery", full(0.75))
    assert row == {**dry, "packets": 1} and (row["agent"], row["channel"], row["to"]) == ("a", "pond", "a")
    line = agent.hear("saw ")
    assert "level=0.75 by=alice." in line, "the dry run published nothing"
    assert float(line.rpartition("stamp=")[2]) > 0.1, "the agent's own mission time"

    (row,) = rows_of(rig, "pub", "a/pond", "battery", full(0.25), "--to", "client/Watch")
    assert (row["to"], row["subscribers"]) == ("a/client/Watch", ["a/client/Watch"])
    agent.hear("saw level=0.25")
    for elsewhere in (("a/pond", "battery", full(0.5), "--to", "client/Walk"), ("a/dry", "battery", full(0.5))):
        result = rig.pancakes("channel", "pub", *elsewhere)
        assert result.returncode == 0 and "no component of a subscribes to battery" in result.stderr


def test_channel_pub_repeats_at_a_rate(shared: tuple[Rig, Running]):
    rig, agent = shared
    (row,) = rows_of(rig, "pub", "a/pond", "battery", full(0.625), "--rate", "50", "--count", "5")
    assert row["packets"] == 5
    for _ in range(5):
        agent.hear("saw level=0.625")

    with closing(LiveOutput(rig, "channel", "echo", "a/dry", "--format", "json")) as echo:
        command = ("channel", "pub", "a/dry", "battery", full(0.5), "--rate", "20", "--format", "json")
        with closing(LiveOutput(rig, *command)) as pub:
            assert echo.record()["source"].startswith("alice.")
            echo.record()  # so the first of them is counted by now
            assert pub.interrupt() == 0
            (row,) = json.loads("\n".join(pub.printed))
    assert row["packets"] >= 1


ACTUATORS = """
from pancakes.devices.driver import Actuator
from pancakes.devices import Twist
from pancakes.errors import PancakesError
from pancakes.task import Task, every

class Stuck(Actuator):
    type = "motors"

    def write(self, command, ttl_s, source):
        if command.v_mps > 1.0:
            raise PancakesError("the wheels are blocked")

    def safe_stop(self):
        pass

class Drive(Task):
    requires = ("motors",)

    @every(hz=10)
    def drive(self, tick):
        self.publish("ctrl", Twist(0.1, 0.0))
"""
OF_ACTUATORS = (
    "[pancakes.drivers]\nstuck.Stuck = plugin_stuck:Stuck\n[pancakes.tasks]\nstuck.Drive = plugin_stuck:Drive\n"
)


def test_channel_pub_shows_refusals_of_actuators(rig: Rig):
    rig.install("stuck", OF_ACTUATORS, ACTUATORS)
    wheels = '[device.wheels]\ndriver = "stuck.Stuck"\n'
    rig.ready("a", wheels)
    rig.ready("b", wheels + '[task.Drive]\ntype = "stuck.Drive"\n')

    def pub(agent: str, v_mps: float, *options: str) -> tuple[int, list[str], str]:
        body = json.dumps({"v_mps": v_mps, "omega_radps": 0.0})
        done = rig.pancakes("channel", "pub", f"{agent}/ctrl", "motors", body, "--format", "json", *options)
        (row,) = json.loads(done.stdout)
        return done.returncode, row["refused"], done.stderr

    assert pub("a", 0.5) == (0, [], "")
    code, refused, said = pub("a", 2.0, "--count", "2", "--rate", "20")
    assert (code, len(refused)) == (1, 1) and "the wheels are blocked" in refused[0]
    assert said.startswith("refused by a/device/wheels: ") and said.count("\n") == 1
    held = "b/device/wheels: it is held by b/client/Drive"
    assert pub("b", 0.5, "--to", "device/wheels") == (1, [held], f"refused by {held}\n")


def test_channel_pub_of_control_packet_is_answered(rig: Rig, agent: Running):
    asked = ("channel", "pub", "a/sysctrl", "stop", '{"target": "Walk"}')
    assert rig.listed(*asked)[0]["packets"] == 1
    agent.hear("task_stopped task=Walk")
    result = rig.pancakes(*asked)
    assert result.returncode == 1 and "stopped already" in result.stderr


def test_the_bytes_of_an_image_are_shown_by_their_beginning():
    record = record_of(
        "a", Packet("system", "camera", "a/device/camera", "", 1.0, 1, CameraFrame(jpeg(320, 240, 5000)))
    )
    text = text_of(record)
    assert len(text) < 400
    assert "characters" in text
    assert len(record["body"]["jpeg"]) > 5000
