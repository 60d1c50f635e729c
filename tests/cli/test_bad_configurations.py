"""`pancakes-agent` and a configuration that is not sound: every mistake at once, as sentences, exit code 4."""

from cli.processes import Rig
from click.testing import CliRunner

from pancakes.tools.cli.agent_command import agent

BAD = """
[device.load]
drivr = "host.load"

[device.memory]
driver = "host.memry"

[task.Drive]
type = "encirclemnt.Drive"
service = "cleint"
rate_hz = -1
"""


def test_agent_names_all_mistakes_of_its_configuration_at_once(rig: Rig):
    path = rig.config("a", BAD)
    said = rig.agent(path, "--set", "clock.speed=fast")
    assert said.ended() == 4
    lines = said.everything().splitlines()
    expected = [
        ("[device.load] drivr", "unknown key, did you mean 'driver'?"),
        ("[device.memory] driver", "unknown driver 'host.memry', did you mean 'host.memory'?"),
        ("[task.Drive] type", "unknown task type 'encirclemnt.Drive'"),
        ("[task.Drive] service", "there is no service 'cleint', did you mean 'client'?"),
        ("[task.Drive] rate_hz", "-1"),
    ]
    text = path.read_text().splitlines()
    for key, problem in expected:
        line = next(line for line in lines if key in line and problem in line)
        number = int(line.removeprefix(f"{path}:").partition(":")[0])
        assert key.rpartition(" ")[2] in text[number - 1]
    assert any(line.startswith("--set clock.speed=fast: [clock] speed:") for line in lines)
    assert not any("Traceback" in line for line in lines)


def test_agent_check_only_checks(rig: Rig):
    assert rig.agent(rig.config("a"), "--check").ended() == 0
    assert rig.agent(rig.config("b", BAD), "--check").ended() == 4
    assert not rig.runtime.exists()


def test_agent_needs_a_file_that_is_there(rig: Rig):
    rig.config("agent1")
    said = rig.agent("agent.toml")
    assert said.ended() == 4
    assert said.everything() == "agent.toml: file: there is no such file, did you mean 'agent1.toml'?"
    usage = CliRunner().invoke(agent, [])
    assert usage.exit_code == 2 and "--config" in usage.output
