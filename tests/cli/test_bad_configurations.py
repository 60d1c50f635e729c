"""`pancakes-agent` with an invalid configuration: all faults at once, as sentences, exit code 4."""

import pytest
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


def test_agent_reports_all_configuration_faults_at_once(rig: Rig):
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


def test_agent_check_starts_nothing(rig: Rig):
    assert rig.agent(rig.config("a"), "--check").ended() == 0
    assert rig.agent(rig.config("b", BAD), "--check").ended() == 4
    assert not rig.runtime.exists()


def test_agent_needs_an_existing_file(rig: Rig):
    rig.config("agent1")
    said = rig.agent("agent.toml")
    assert said.ended() == 4
    assert said.everything() == "agent.toml: file: there is no such file, did you mean 'agent1.toml'?"
    usage = CliRunner().invoke(agent, [])
    assert usage.exit_code == 2 and "--config" in usage.output


@pytest.mark.parametrize(
    ("config", "key"),
    [
        ({"agent.state_dir": r"a\u0000b"}, "[agent] state_dir"),
        ({"agent.folders": [r"a\u0000b"]}, "[agent] folders[0]"),
        ({"record.path": r"a\u0000b"}, "[record] path"),
        ({"service.network.settings.keys": r"a\u0000b"}, "[service.network] settings.keys"),
        ({"service.log.settings.file": r"~/a\u0000b"}, "[service.log] settings.file"),
    ],
)
def test_path_with_nul_is_refused(rig: Rig, config: dict[str, object], key: str):
    path = rig.config("a")
    sets = [word for name, value in config.items() for word in ("--set", f"{name}={_toml(value)}")]
    for check in ((), ("--check",)):
        agent = rig.agent(path, *sets, *check)
        assert agent.ended() == 4
        assert f"{key}: has a NUL in it, which no path may have" in agent.everything()


def _toml(value: object) -> str:
    return f"[{', '.join(map(_toml, value))}]" if isinstance(value, list) else f'"{value}"'


@pytest.mark.parametrize(
    ("set_", "key", "why"),
    [
        ('agent.state_dir="/etc/passwd"', "[agent] state_dir", "/etc/passwd is not a directory"),
        ('agent.state_dir="/etc/passwd/a/b"', "[agent] state_dir", "/etc/passwd is not a directory"),
        ('agent.listen=["tcp://192.0.2.7:7401"]', "[agent] listen", "tcp://192.0.2.7:7401: cannot assign requested"),
        ('agent.listen=["tcp://no-such.invalid:7401"]', "[agent] listen", "tcp://no-such.invalid:7401: "),
        ('agent.listen=["local:///etc/passwd/x"]', "[agent] listen", "/etc/passwd is not a directory"),
        ('agent.local_group="no-such-group"', "[agent] local_group", "the group 'no-such-group' does not exist"),
        (r'agent.local_group="a\u0000b"', "[agent] local_group", r"the group 'a\x00b' does not exist"),
    ],
)
def test_check_warns_of_what_cannot_start_here(rig: Rig, set_: str, key: str, why: str):
    path = rig.config("a")
    checked = rig.agent(path, "--set", set_, "--check")
    assert checked.ended() == 0
    line = next(line for line in checked.everything().splitlines() if line.startswith("warning: ") and key in line)
    assert "it would not start on this machine: " in line and why in line
    started = rig.agent(path, "--set", set_)
    assert started.ended() in (1, 4), "the warning is true"
    assert "defect" not in started.everything() and "Traceback" not in started.everything()


def test_check_accepts_addresses_of_this_machine(rig: Rig):
    path = rig.config("a")
    for listen in ("tcp://127.0.0.1:7401", "tcp://0.0.0.0:0", "tcp://[::1]:0", "local://a"):
        checked = rig.agent(path, "--set", f'agent.listen=["{listen}"]', "--check")
        assert checked.ended() == 0 and "warning" not in checked.everything()
