"""`pancakes-agent` and a configuration that is not sound: every mistake at once, as sentences, exit code 4."""

from cli.processes import Rig

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


def test_all_mistakes_are_named_at_once_with_file_line_and_key(rig: Rig):
    path = rig.config("a", BAD)

    said = rig.agent(path)

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
    assert not any("Traceback" in line for line in lines)


def test_a_mistake_in_an_override_is_named_too(rig: Rig):
    said = rig.agent(rig.config("a"), "--set", "clock.speed=fast")

    assert said.ended() == 4
    assert "--set clock.speed=fast: [clock] speed:" in said.everything()


def test_a_file_that_is_not_there(rig: Rig):
    rig.config("agent1")

    said = rig.agent("agent.toml")

    assert said.ended() == 4
    assert said.everything() == "agent.toml: file: there is no such file, did you mean 'agent1.toml'?"


def test_no_file_at_all_is_a_mistake_of_usage(rig: Rig):
    said = rig.run("-m", "pancakes.tools.cli.agent_command")

    assert said.ended() == 2
    assert "--config" in said.everything()


def test_a_task_that_needs_a_device_that_the_agent_lacks(rig: Rig):
    rig.install(
        "walker",
        "[pancakes.tasks]\nwalker.Walk = plugin_walker:Walk\n",
        "from pancakes.task import Task\n\nclass Walk(Task):\n    requires = ('motors',)\n",
    )

    said = rig.agent(rig.config("a", '[device.load]\ndriver = "host.load"\n[task.Walk]\ntype = "walker.Walk"\n'))

    assert said.ended() == 4
    assert "[task.Walk] type: needs a device of the type motors; this agent has load" in said.everything()


def test_check_only_checks(rig: Rig):
    good = rig.run("-m", "pancakes.tools.cli.agent_command", "--config", str(rig.config("a")), "--check")
    bad = rig.run("-m", "pancakes.tools.cli.agent_command", "--config", str(rig.config("b", BAD)), "--check")

    assert good.ended() == 0
    assert bad.ended() == 4
    assert not rig.runtime.exists()
