"""An agent starts with keys that are its own and that it alone can read, or says why it does not."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from cli.processes import READY, Rig


def another_user(key: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("a file can be given to another user by root alone")
    os.chown(key, 65534, -1)


@pytest.mark.parametrize(
    ("harm", "why"),
    [
        (lambda key: key.chmod(0o644), "can be read by others (mode 644): chmod 600 it"),
        (another_user, "belongs to another user (uid 65534)"),
        (lambda key: key.write_text("no key"), "cannot be used: "),
        (lambda key: key.parent.chmod(0o777), "others can put other files into the folder with keys"),
    ],
    ids=["mode 644", "another user", "no key", "an open folder"],
)
def test_keys_that_are_of_no_use_are_a_fault_of_the_configuration(rig: Rig, harm: Callable[[Path], None], why: str):
    config = rig.config("a")
    harm(rig.keys.of_agent("test", "a") / "key.pem")
    agent = rig.agent(config)
    assert agent.ended() == 4
    said = agent.everything()
    assert f"{config}:4: [agent] name: " in said and why in said and "Traceback" not in said


def test_an_agent_without_keys_says_which_it_needs(rig: Rig):
    config = rig.config("a")
    shutil.rmtree(rig.keys.of_agent("test", "a"))
    agent = rig.agent(config)
    assert agent.ended() == 4
    assert (
        f"{config}:6: [agent] listen: 'tcp://127.0.0.1:0' needs keys of the agent a of the fleet test: run pancakes"
        " fleet join, or use local://a for this machine alone" in agent.everything()
    )
    checked = rig.agent(config, "--check")
    assert checked.ended() == 0
    assert "warning: on this machine it does not start: " in checked.everything()


def test_the_keys_of_another_agent_are_not_taken(rig: Rig):
    other = rig.keys.of_agent("test", "b")
    config = rig.config("a", f'[service.network]\nsettings = {{ keys = "{other}" }}\n')
    agent = rig.agent(config)
    assert agent.ended() == 4
    assert f"[service.network] settings.keys: the keys in {other} are not those of this agent" in agent.everything()


def test_an_agent_whose_certificate_was_revoked_runs_and_says_so(rig: Rig):
    config = rig.config("a")
    office = rig.keys.office("test")
    office.revoke("a", "lost")
    office.sign()
    roster = office.folder / "roster.json"
    (rig.keys.of_agent("test", "a") / "roster.json").write_bytes(roster.read_bytes())
    agent = rig.agent(config)
    agent.hear(READY)
    agent.hear("no agent of test believes this one any more: its certificate was revoked")


def test_a_launcher_starts_no_agent_again_whose_key_is_of_no_use(rig: Rig):
    config = rig.config("a")
    (rig.keys.of_agent("test", "a") / "key.pem").chmod(0o644)
    result = rig.pancakes("launch", str(config))
    assert result.returncode == 1
    said = result.stdout + result.stderr
    assert said.count("can be read by others (mode 644): chmod 600 it") == 1 and "given up" in said
