"""`pancakes channel ...`: who is on the channels of agents that run, and the packets on them."""

import json
from collections.abc import Callable
from typing import Any

import pytest
from cli.live_output import LiveOutput
from cli.processes import Rig, Running

from pancakes.bodies.devices.types import Pose
from pancakes.packet import Packet
from pancakes.tools.cli.verbs.throughput import size_of

SOURCE = """
from pancakes.bodies.devices.types import Battery, Pose, Sonar
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
        self.event("saw", level=packet.body.level, by=packet.source, stamp=packet.stamp)
"""
TASKS = '[channel.pond]\n[channel.dry]\n[task.Walk]\ntype = "walk.Walk"\n[task.Watch]\ntype = "walk.Watch"\n'
FULL = '{"voltage_v": 7.4, "level": 0.75}'

Start = Callable[..., LiveOutput]


@pytest.fixture
def agent(rig: Rig) -> Running:
    rig.install("walk", "[pancakes.tasks]\nwalk.Walk = plugin_walk:Walk\nwalk.Watch = plugin_walk:Watch\n", SOURCE)
    return rig.ready("a", TASKS)


def rows_of(rig: Rig, *arguments: str) -> list[dict[str, Any]]:
    """Runs a command that prints JSON and succeeds."""
    result = rig.pancakes("channel", *arguments, "--format", "json")
    assert result.returncode == 0, result.stderr
    rows: list[dict[str, Any]] = json.loads(result.stdout)
    return rows


# Who is there --------------------------------------------------------------------------------------------------------


def test_channels_are_listed_with_how_many_are_on_them(rig: Rig, agent: Running):
    rig.ready("b")

    rows = rows_of(rig, "list")
    assert {
        "agent": "a",
        "channel": "pond",
        "core": False,
        "subscribers": 1,
        "waiting": 0,
        "dropped": 0,
        "followers": 0,
    } in rows
    assert [row["channel"] for row in rows if row["agent"] == "b"] == ["system", "sysctrl", "ctrl", "network", "log"]
    assert {row["agent"] for row in rows_of(rig, "list", "a")} == {"a"}


def near(hz: float) -> Any:
    """What is measured of a task at this rate: a busy machine misses ticks, and none invents any."""
    return pytest.approx(0.75 * hz, rel=0.5)  # from 3/8 to 9/8


def test_a_channel_shows_who_reads_follows_and_publishes_on_it(rig: Rig, agent: Running, start: Start):
    start("channel", "echo", "a/pond").line("pose")

    (row,) = rows_of(rig, "info", "a/pond")

    (reader,) = row["subscribers"]
    assert (reader["address"], reader["types"], reader["limit"]) == ("a/client/Watch", ["battery"], 256)
    assert len(row["followers"]) == 1  # the other command, and not this one
    sonar, pose = sorted(row["publishers"], key=lambda it: it["packets"])
    assert (sonar["source"], sonar["type"], pose["type"]) == ("a/client/Walk", "sonar", "pose")
    assert pose["rate_hz"] == near(50.0)
    assert sonar["rate_hz"] == near(10.0)


def test_a_channel_on_which_nothing_happens_says_so(rig: Rig, agent: Running):
    text = rig.pancakes("channel", "info", "a/dry", "--for", "100ms").stdout

    assert "No component of this agent subscribes to it." in text
    assert "Followed from elsewhere by none." in text
    assert "No packet was published on it within 0.1 s." in text


@pytest.mark.parametrize("verb", ["info", "echo", "hz", "bw"])
def test_a_channel_that_is_not_there_is_refused(rig: Rig, agent: Running, verb: str):
    result = rig.pancakes("channel", verb, "a/lake", "--for", "1s")

    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr == "a has no channel 'lake', only system, sysctrl, ctrl, network, log, pond, dry\n"


# echo ----------------------------------------------------------------------------------------------------------------


def test_packets_are_shown_and_counted(rig: Rig, agent: Running):
    rows = rows_of(rig, "echo", "a/pond", "--type", "pose", "--count", "3")

    assert len(rows) == 3
    assert rows[1]["seq"] > rows[0]["seq"]
    assert {key: rows[0][key] for key in ("agent", "channel", "type", "source", "body")} == {
        "agent": "a",
        "channel": "pond",
        "type": "pose",
        "source": "a/client/Walk",
        "body": {"x_m": 1.0, "y_m": 2.0, "theta_rad": 0.5},
    }


def test_for_people_a_packet_is_yaml(rig: Rig, agent: Running):
    lines = rig.pancakes("channel", "echo", "a/pond", "--type", "sonar", "--count", "1").stdout.splitlines()

    assert lines[:2] == ["type: sonar", "source: a/client/Walk"]
    assert lines[4:] == [
        "body:",
        "  bearings_rad: [0.0,1.0]",
        "  ranges_m: [0.25,0.75]",
        "  max_range_m: 2",
        "---",
    ]


def test_a_field_that_no_packet_of_a_type_has_is_not_waited_for(rig: Rig, agent: Running):
    result = rig.pancakes("channel", "echo", "a/system", "--type", "load", "--field", "cpuu", "--count", "1")
    assert result.returncode == 2
    assert "load has no field 'cpuu', did you mean 'cpu'?" in result.stderr


def test_fields_are_picked_and_packets_without_them_left_out(rig: Rig, agent: Running):
    result = rig.pancakes(
        "channel", "echo", "a/pond", "--field", "ranges_m.1", "--field", "packet.type", "--count", "2"
    )

    assert result.stdout == "0.75\tsonar\n" * 2
    assert result.stderr == (
        "packets of the type pose are left out: they have no ranges_m.1, only x_m, y_m, theta_rad\n"
    )
    assert rows_of(rig, "echo", "a/pond", "--type", "pose", "--field", "x_m", "--count", "1") == [{"x_m": 1.0}]
    # With --type the class is known here, and its fields are tuples instead of lists.
    of_a_type = rows_of(rig, "echo", "a/pond", "--type", "sonar", "--field", "ranges_m.1", "--count", "1")
    assert of_a_type == [{"ranges_m.1": 0.75}]


def test_only_packets_from_an_address_are_shown(rig: Rig, agent: Running, start: Start):
    echo = start("channel", "echo", "a/pond", "--from", "a/client/Wal", "--from", "alice", "--for", "1s")
    assert echo.ended() == 0
    assert echo.printed == []
    assert rows_of(rig, "echo", "a/pond", "--from", "a/client", "--count", "1")


def test_a_type_that_is_not_known_is_doubted(rig: Rig, agent: Running):
    result = rig.pancakes("channel", "echo", "a/pond", "--type", "posse", "--for", "100ms", "--format", "json")

    assert (result.returncode, json.loads(result.stdout)) == (0, [])
    assert result.stderr == "no packet type 'posse' is installed here, did you mean 'pose'?\n"


def test_without_an_end_each_line_is_an_object_until_ctrl_c(agent: Running, start: Start):
    echo = start("channel", "echo", "a/pond", "--format", "json")

    assert echo.record("pose")["body"]["x_m"] == 1.0
    assert echo.record("sonar")["type"] == "sonar"
    assert echo.interrupt() == 0
    assert echo.said == []


def test_ctrl_c_ends_a_list_too(agent: Running, start: Start):
    echo = start("channel", "echo", "a/pond", "--count", "1000000", "--format", "json")
    echo.line("pose")

    assert echo.interrupt() == 0
    assert len(json.loads("\n".join(echo.printed))) >= 1


@pytest.mark.parametrize("format_", ["table", "json"])
def test_who_reads_the_output_may_go(rig: Rig, agent: Running, format_: str):
    import subprocess
    import sys

    command = [sys.executable, "-m", "pancakes.tools.cli.main", "channel", "echo", "a/pond", "--format", format_]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=rig.environment, text=True
    ) as echo:
        assert echo.stdout is not None and echo.stderr is not None
        echo.stdout.readline()
        echo.stdout.close()
        assert echo.wait(20.0) == 0
        assert echo.stderr.read() == ""


def test_what_comes_from_elsewhere_is_seen(rig: Rig, agent: Running, start: Start):
    echo = start("channel", "echo", "a/dry", "--format", "json")
    rig.ready("b")
    pub = start("channel", "pub", "a/dry", "battery", FULL, "--rate", "20")

    assert echo.record()["source"].startswith("alice.")
    assert pub.interrupt() == 0


def test_an_agent_that_comes_back_elsewhere_is_followed_again(rig: Rig, agent: Running, start: Start):
    echo = start("channel", "echo", "a/pond", "--type", "pose", "--field", "packet.stamp")
    echo.line()
    agent.process.kill()
    echo.hear("a is away: waiting for it to come back")
    last_s = float(echo.last())

    rig.ready("a", TASKS)

    echo.hear("a is here")
    assert float(echo.line()) != last_s
    assert echo.interrupt() == 0


def test_an_agent_that_does_not_come_back_is_exit_code_3(agent: Running, start: Start):
    forever = start("channel", "echo", "a/pond")
    counts = start("channel", "echo", "a/pond", "--count", "1000000", "--timeout", "0.5")
    ends_late = start("channel", "echo", "a/pond", "--for", "2500ms")
    for it in (forever, counts, ends_late):
        it.line()
    agent.process.kill()

    assert counts.ended() == 3
    assert counts.said[-1] == "a did not come back within 0.5 s"
    assert ends_late.ended() == 3
    assert ends_late.said[-1] == "a went away and did not come back"
    forever.hear("a is away")
    assert forever.interrupt() == 0


def test_the_network_service_of_an_agent_is_started_anew(rig: Rig, agent: Running, start: Start):
    echo = start("channel", "echo", "a/pond", "--type", "pose", "--field", "packet.seq")
    echo.line()
    assert rig.pancakes("service", "restart", "a/network").returncode == 0
    (now,) = rows_of(rig, "echo", "a/pond", "--type", "pose", "--count", "1")

    while int(echo.line()) <= now["seq"]:
        pass
    assert echo.interrupt() == 0


# hz, bw --------------------------------------------------------------------------------------------------------------


def test_rates_are_measured_for_each_source_and_type(rig: Rig, agent: Running):
    pose, sonar = rows_of(rig, "hz", "a/pond", "--for", "2s")

    assert list(pose) == ["source", "type", "rate_hz", "min_s", "max_s", "std_dev_s", "window"]
    assert (pose["type"], sonar["type"]) == ("pose", "sonar")
    assert pose["rate_hz"] == near(50.0)
    assert sonar["rate_hz"] == near(10.0)
    assert pose["min_s"] <= 0.02 <= pose["max_s"]
    assert pose["window"] == pytest.approx(2.0 * pose["rate_hz"], rel=0.1)


def test_rates_are_those_of_the_mission(rig: Rig, agent: Running):
    fast = rig.agent(rig.config("fast", TASKS), "--set", "clock.speed=4")
    fast.hear("ready")

    (mission,) = rows_of(rig, "hz", "fast/pond", "--type", "sonar", "--for", "1s")
    (host,) = rows_of(rig, "hz", "fast/pond", "--type", "sonar", "--for", "1s", "--wall-time")

    assert mission["rate_hz"] == near(10.0)
    assert host["rate_hz"] == near(40.0)


def test_bytes_are_those_on_the_wire(rig: Rig, agent: Running):
    pose, sonar, whole = rows_of(rig, "bw", "a/pond", "--for", "2s")

    size = size_of(Packet("pond", "pose", "a/client/Walk", "", 1.5, 100, Pose(1.0, 2.0, 0.5)))
    assert pose["mean_bytes"] == pytest.approx(size, abs=25)  # numbers grow, and there is the tick that caused it
    assert pose["bytes_per_s"] == near(50.0 * pose["mean_bytes"])
    assert (whole["source"], whole["type"]) == ("all", "all")
    assert whole["bytes_per_s"] == pytest.approx(pose["bytes_per_s"] + sonar["bytes_per_s"])
    assert whole["window"] == pose["window"] + sonar["window"]


def test_a_measurement_without_an_end_reports_each_second(agent: Running, start: Start):
    hz = start("channel", "hz", "a/pond", "--type", "pose", "--format", "json")

    first, second = hz.record(), hz.record()

    assert first["rate_hz"] == near(50.0)
    assert 20 <= second["window"] - first["window"] <= 60
    assert hz.interrupt() == 0


def test_it_ends_after_a_number_of_packets(rig: Rig, agent: Running):
    (pose,) = rows_of(rig, "hz", "a/pond", "--type", "pose", "--count", "20")
    assert pose["window"] == 20

    result = rig.pancakes("channel", "bw", "a/pond", "--type", "pose", "--count", "5", "--window", "3")
    head, _, row = (line.split() for line in result.stdout.splitlines() if line.strip())
    assert head == ["source", "type", "bytes_per_s", "min_bytes", "mean_bytes", "max_bytes", "window"]
    assert (row[0], row[-1]) == ("a/client/Walk", "3")


def test_silence_is_said(rig: Rig, agent: Running):
    result = rig.pancakes("channel", "hz", "a/dry", "--for", "100ms")

    assert (result.returncode, result.stdout, result.stderr) == (0, "", "nothing new on a/dry\n")


# pub -----------------------------------------------------------------------------------------------------------------


def test_a_packet_reaches_who_subscribes(rig: Rig, agent: Running):
    (row,) = rows_of(rig, "pub", "a/pond", "battery", FULL)

    assert row == {
        "agent": "a",
        "channel": "pond",
        "type": "battery",
        "to": "a",
        "packets": 1,
        "subscribers": ["a/client/Watch"],
    }
    line = agent.hear("saw level=0.75")
    assert "by=alice." in line
    assert float(line.rpartition("stamp=")[2]) > 0.1  # the agent's own mission time


def test_packets_are_published_at_a_rate(rig: Rig, agent: Running, start: Start):
    (row,) = rows_of(rig, "pub", "a/pond", "battery", FULL, "--rate", "50", "--count", "5")
    assert row["packets"] == 5
    for _ in range(5):
        agent.hear("saw level=0.75")

    pub = start("channel", "pub", "a/pond", "battery", FULL, "--rate", "20", "--format", "json")
    agent.hear("saw level=0.75")
    agent.hear("saw level=0.75")  # so the first of them is counted by now
    assert pub.interrupt() == 0
    (row,) = json.loads("\n".join(pub.printed))
    assert row["packets"] >= 1


def test_a_packet_goes_to_one_task_only(rig: Rig, agent: Running):
    (row,) = rows_of(rig, "pub", "a/pond", "battery", FULL, "--to", "client/Watch")
    assert (row["to"], row["subscribers"]) == ("a/client/Watch", ["a/client/Watch"])
    agent.hear("saw level=0.75")

    result = rig.pancakes("channel", "pub", "a/pond", "battery", FULL, "--to", "client/Walk")
    assert result.returncode == 0
    assert result.stderr == "no component of a subscribes to battery on pond at client/Walk\n"
    assert rig.pancakes("channel", "pub", "a/pond", "battery", FULL, "--to", "b/client/Watch").returncode == 2
    assert rig.pancakes("channel", "pub", "a/pond", "battery", FULL, "--to", "*").returncode == 2


def test_a_dry_run_publishes_nothing(rig: Rig, agent: Running):
    (row,) = rows_of(rig, "pub", "a/pond", "battery", '{"voltage_v": 1, "level": 0.5}', "--dry-run")
    assert (row["packets"], row["subscribers"]) == (0, ["a/client/Watch"])

    rows_of(rig, "pub", "a/pond", "battery", FULL)

    assert "level=0.75" in agent.hear("saw level=")


def test_a_packet_for_nobody_is_said(rig: Rig, agent: Running):
    result = rig.pancakes("channel", "pub", "a/dry", "battery", FULL)

    assert result.returncode == 0
    assert result.stderr == "no component of a subscribes to battery on dry\n"


def test_a_control_packet_is_answered(rig: Rig, agent: Running):
    assert rows_of(rig, "pub", "a/sysctrl", "stop", '{"target": "Walk"}')[0]["packets"] == 1
    agent.hear("task_stopped task=Walk")

    result = rig.pancakes("channel", "pub", "a/sysctrl", "stop", '{"target": "Walk"}')
    assert (result.returncode, result.stderr) == (1, "a/client/Walk is stopped already\n")


def test_pub_to_a_channel_or_an_agent_that_is_not_there(rig: Rig, agent: Running):
    result = rig.pancakes("channel", "pub", "a/lake", "battery", FULL)
    assert (result.returncode, result.stderr.partition(",")[0]) == (1, "a has no channel 'lake'")
    assert rig.pancakes("channel", "pub", "b/pond", "battery", FULL).returncode == 3


@pytest.mark.parametrize(
    ("kind", "body", "said"),
    [
        ("batery", FULL, "no packet type 'batery' is installed here, did you mean 'battery'?"),
        ("battery", '{"voltage_v": "high", "level": 1}', "battery.voltage_v: expected `float`, got `str`"),
        ("battery", '{"level": 1}', "battery: object missing required field `voltage_v`"),
        ("battery", '{"voltage_v": 1, "level": 1, "livel": 2}', "battery has no field 'livel', did you mean 'level'?"),
        ("battery", "[1, 2]", "the body must be a JSON object"),
        ("battery", '{"level": ', "the body is no JSON: input data was truncated"),
        ("battery", "{level: 1}", "the body is no JSON: object keys must be strings"),
    ],
)
def test_a_body_that_does_not_fit_is_never_sent(rig: Rig, kind: str, body: str, said: str):
    result = rig.pancakes("channel", "pub", "a/pond", kind, body)

    assert result.returncode == 2
    assert said in result.stderr


@pytest.mark.parametrize("verb", ["list", "info", "echo", "hz", "bw", "pub"])
def test_each_verb_has_help_with_an_example(rig: Rig, verb: str):
    assert f"pancakes channel {verb}" in rig.pancakes("channel", verb, "--help").stdout.partition("Example:")[2]


@pytest.mark.parametrize(
    "arguments",
    [
        ("echo", "pond"),
        ("echo", "test/a/client/pond"),
        ("echo", "a/pond", "--count", "0"),
        ("hz", "a/pond", "--for", "soon"),
        ("hz", "a/pond", "--window", "1"),
        ("pub", "a/pond", "battery", FULL, "--rate", "0"),
    ],
)
def test_what_cannot_be_read_is_exit_code_2(rig: Rig, arguments: tuple[str, ...]):
    assert rig.pancakes("channel", *arguments).returncode == 2
