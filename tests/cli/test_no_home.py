"""The environment of a container: a user without HOME and without an entry in the passwd file."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing

import pytest
from cli.processes import INSECURE, PATIENCE_S, READY, Rig, Running
from harness.nameless_user import UID, as_nameless, may_be_nameless, without_folders
from harness.programs import AGENT, PANCAKES, run

pytestmark = pytest.mark.skipif(not may_be_nameless(), reason="no namespace of one's own may be made here")


@pytest.fixture
def nameless(rig: Rig) -> Rig:
    rig.environment = without_folders(rig.environment)
    return rig


def pancakes(rig: Rig, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = as_nameless(sys.executable, "-m", PANCAKES, *arguments)
    done = run(command, timeout_s=PATIENCE_S, env=rig.environment | environment, cwd=rig.directory)
    assert "Traceback" not in done.stderr and "defect" not in done.stderr, done.stderr
    return done


@pytest.fixture
def agent(nameless: Rig) -> Iterator[Running]:
    path = nameless.config("a", INSECURE, agent=f'state_dir = "{nameless.directory / "state-of-a"}"')
    command = as_nameless(sys.executable, "-m", AGENT, "--config", str(path))
    with closing(Running(command, nameless.environment, nameless.directory)) as running:
        running.hear(READY)
        yield running


def test_agent_with_a_state_directory_runs_without_home(nameless: Rig, agent: Running):
    assert " a " in pancakes(nameless, "agent", "list").stdout
    found = pancakes(nameless, "doctor")
    assert f"the user {UID} has no home folder. Set HOME or XDG_STATE_HOME" in found.stdout
    listed = pancakes(nameless, "keys", "list")
    assert listed.returncode == 1 and "Set HOME or XDG_CONFIG_HOME" in listed.stderr
    assert pancakes(nameless, "task", "list").returncode == 0
    assert pancakes(nameless, "log", "a").returncode == 0


def test_unknown_folders_are_reported_with_their_variables(nameless: Rig):
    path = nameless.config("b", INSECURE)
    command = as_nameless(sys.executable, "-m", AGENT, "--config", str(path))
    with closing(Running(command, nameless.environment, nameless.directory)) as running:
        told = running.everything()
    assert f"nothing says where the state of b belongs: the user {UID} has no home folder." in told
    assert "Set HOME or XDG_STATE_HOME, or state_dir in [agent]" in told and "Traceback" not in told

    done = pancakes(nameless, "keys", "init", "garage", "--me", "eve", "--no-password")
    assert done.returncode == 1
    assert "nothing says where the fleets of this person belong" in done.stderr
    assert "Set HOME or XDG_CONFIG_HOME" in done.stderr
    assert pancakes(nameless, "config", "check", str(path)).returncode == 0

    named = str(nameless.directory / "config")
    assert pancakes(nameless, "keys", "init", "garage", "--me", "eve", "--no-password", XDG_CONFIG_HOME=named)
