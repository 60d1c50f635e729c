"""Rules of a fleet on running agents: what an observer may not do, how to grant it, and the messages."""

from __future__ import annotations

import subprocess

import pytest
from cli.processes import Rig

LAMP = '[device.motors]\ndriver = "null.motors"\n'


@pytest.fixture
def observed(rig: Rig):
    """Yield the address of an agent, and a function that runs a command as the observer bob on his own machine."""
    agent = rig.ready("a", LAMP)
    bob = rig.directory / "bob"
    rig.keys.authority("test").enrol_with_key("observer", "bob").write(bob / "pancakes" / "fleets" / "test" / "me")
    (rig.directory / "bobs").mkdir(mode=0o700)
    other = {"XDG_CONFIG_HOME": str(bob), "PANCAKES_RUNTIME_DIR": str(rig.directory / "bobs")}

    def as_bob(*arguments: str) -> subprocess.CompletedProcess[str]:
        before = dict(rig.environment)
        rig.environment.update(other)
        try:
            return rig.pancakes(*arguments, "--at", rig.address(agent).removeprefix("tcp://"), "--fleet", "test")
        finally:
            rig.environment.clear()
            rig.environment.update(before)

    rig.address(agent)
    return rig, agent, as_bob


def test_keys_rules_take_effect_at_once(observed):
    rig, agent, as_bob = observed
    seen = as_bob("task", "list")
    assert seen.returncode == 0 and "motors" in seen.stdout, seen.stderr
    refused = as_bob("task", "stop", "a/motors")
    assert refused.returncode == 1
    assert "pancakes keys allow bob change --on 'a/device/motors' --agent a" in refused.stderr
    assert "it lacks the right 'end' on 'a'" in as_bob("down", "a").stderr
    assert agent.process.poll() is None

    asked = ("bob", "change", "a/device/motors", "--agent", "a", "--fleet", "test")
    no = rig.pancakes("keys", "can", *asked)
    assert no.returncode == 1 and "no: no rule of the roster 1 gives observer/bob the right 'change'" in no.stderr

    granted = rig.pancakes("keys", "allow", "bob", "change", "--on", "a/device/*", "--agent", "a", "--fleet", "test")
    assert granted.returncode == 0 and "The roster 2 is known to a." in granted.stdout, granted.stderr
    yes = rig.pancakes("keys", "can", *asked)
    assert yes.returncode == 0 and yes.stdout.startswith("yes: bob may change on a/device/* at a (roster 2)")
    assert as_bob("task", "stop", "a/motors").returncode == 0

    rules = rig.keys.authority("test").folder / "rules.toml"
    rules.write_text(rules.read_text().replace('may = ["change"]', 'may = ["replay"]'))
    assert rig.pancakes("keys", "sign", "--fleet", "test").returncode == 0
    assert "it lacks the right 'change'" in as_bob("task", "start", "a/motors").stderr


def test_invalid_fleet_rules_are_refused(rig: Rig):
    authority = rig.keys.authority("test")
    authority.enrol_with_key("observer", "bob")
    rules = authority.folder / "rules.toml"
    before = rules.read_bytes()
    shown = rig.pancakes("keys", "allow", "bob", "change", "--fleet", "test", "--dry-run")
    assert shown.returncode == 0 and "dry run" in shown.stdout
    for words, why in (
        (("can", "carol", "look", "a"), "has no carol"),
        (("can", "bob", "fly", "a"), "'fly' is not one of"),
        (("allow", "bob", "fly"), "'fly' is not one of"),
    ):
        refused = rig.pancakes("keys", *words, "--fleet", "test")
        assert refused.returncode != 0 and why in refused.stderr and "Traceback" not in refused.stderr
    assert rules.read_bytes() == before

    rules.write_text("[[access.allow]]\nwho = ['bob']\nmay = ['fly']\n")
    refused = rig.pancakes("keys", "sign", "--fleet", "test")
    assert refused.returncode == 1 and f"the rules {rules} are not valid" in refused.stderr
