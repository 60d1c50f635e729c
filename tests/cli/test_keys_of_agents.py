"""An agent starts only with its own keys, which only it can read; otherwise it reports why."""

from __future__ import annotations

import os
import shutil

from cli.processes import READY, Rig


def test_unusable_keys_are_a_configuration_fault(rig: Rig):
    config = rig.config("a")
    keys = rig.keys.of_agent("test", "a")
    key, sound = keys / "key.pem", (keys / "key.pem").read_bytes()
    harms = {
        "can be read by others (mode 644): chmod 600 it": lambda: key.chmod(0o644),
        "cannot be used: ": lambda: key.write_text("no key"),
        "others can put files into the key folder": lambda: keys.chmod(0o777),
    }
    if os.geteuid() == 0:  # only root can give a file to another user
        harms["belongs to another user (uid 65534)"] = lambda: os.chown(key, 65534, -1)
    for why, harm in harms.items():
        harm()
        agent = rig.agent(config)
        assert agent.ended() == 4, why
        said = agent.everything()
        assert f"{config}:4: [agent] name: " in said and why in said and "Traceback" not in said
        os.chown(key, os.geteuid(), -1)
        key.write_bytes(sound)
        key.chmod(0o600)
        keys.chmod(0o700)
    key.chmod(0o644)
    result = rig.pancakes("up", str(config))
    assert result.returncode == 1, "a launcher does not start it again"
    said = result.stdout + result.stderr
    assert said.count("can be read by others (mode 644): chmod 600 it") == 1 and "given up" in said


def test_foreign_or_missing_keys_are_refused(rig: Rig):
    other = rig.keys.of_agent("test", "b")
    config = rig.config("a", f'[service.network]\nsettings = {{ keys = "{other}" }}\n')
    agent = rig.agent(config)
    assert agent.ended() == 4
    assert f"[service.network] settings.keys: the keys in {other} are not those of this agent" in agent.everything()

    config = rig.config("a")
    shutil.rmtree(rig.keys.of_agent("test", "a"))
    agent = rig.agent(config)
    assert agent.ended() == 4
    assert (
        f"{config}:6: [agent] listen: 'tcp://127.0.0.1:0' needs keys of the agent a of the fleet test: run pancakes"
        " keys join, or use local://a for this machine only" in agent.everything()
    )
    checked = rig.agent(config, "--check")
    assert checked.ended() == 0
    said = f"warning: {config}:6: [agent] listen: it would not start on this machine: "
    assert said in checked.everything()
    by_verb = rig.pancakes("config", "check", str(config))
    assert by_verb.returncode == 0 and by_verb.stderr.startswith(said) and "is sound" in by_verb.stdout
    (row,) = rig.listed("config", "check", str(config))
    assert row["faults"] == [] and row["warnings"][0]["problem"].startswith("it would not start on this machine")


def test_agent_with_revoked_keys_runs_and_warns(rig: Rig):
    config = rig.config("a")
    authority = rig.keys.authority("test")
    authority.revoke("a", "lost")
    authority.sign()
    roster = authority.folder / "roster.json"
    (rig.keys.of_agent("test", "a") / "roster.json").write_bytes(roster.read_bytes())
    agent = rig.agent(config)
    agent.hear(READY)
    agent.hear("no agent of test believes this one any more: its certificate was revoked")
