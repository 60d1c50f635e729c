"""Rosters that agents cannot check or store: `revoke` and `sign` fail, and `doctor` reports the agent."""

from __future__ import annotations

import json
import subprocess
from contextlib import suppress
from pathlib import Path

import pytest
from cli.processes import READY, Rig, Running

from pancakes.security.key_store import ROSTER, write_private

MISSING = "import sys\nsys.modules['cryptography'] = None\n"


def without_cryptography(rig: Rig, name: str) -> Running:
    """Start an agent on a machine without the extra `keys`."""
    folder = rig.directory / "missing"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(MISSING)
    ours = rig.environment
    rig.environment = {**ours, "PYTHONPATH": f"{folder}:{ours['PYTHONPATH']}"}
    agent = rig.agent(rig.config(name), true_start=True)
    rig.environment = ours
    agent.hear(READY)
    agent.hear("this agent goes on to believe members that are revoked")
    rig.entry(agent.pid)
    return agent


def findings(rig: Rig) -> dict[str, tuple[str, str]]:
    rows = json.loads(rig.pancakes("doctor", "--no-machine", "--format", "json").stdout)
    return {row["about"]: (row["level"], row["text"]) for row in rows if "roster" in row["text"]}


@pytest.mark.parametrize("words", [("revoke", "bob", "laptop stolen", "--yes"), ("sign",), ("allow", "b", "command")])
def test_unchecked_roster_fails_and_is_reported(rig: Rig, words: tuple[str, ...]):
    rig.keys.authority("test").enrol_with_key("operator", "bob")
    agent = without_cryptography(rig, "a")
    rig.ready("b", agent=f'peers = ["{rig.address(agent)}"]').hear("a (agent, ")
    assert findings(rig)["a"][0] == "error"
    assert "a roster cannot be checked without cryptography" in findings(rig)["a"][1]

    done = rig.pancakes("keys", *words)

    assert done.returncode == 1, done.stdout
    assert "known to b" in done.stdout and "a does not apply the roster" in done.stderr
    assert "cannot be checked without cryptography: pip install 'pancakes-agents[keys]'" in done.stderr
    assert "b" not in findings(rig)


def test_doctor_reports_a_roster_that_agents_lack(rig: Rig):
    rig.ready("a")
    assert findings(rig) == {}
    authority = rig.keys.authority("test")
    number = authority.sign().number
    (authority.folder / "me" / ROSTER).unlink()  # so that the terminal has no roster to pass on
    level, text = findings(rig)["a"]
    assert level == "warning" and f"the roster {number}" in text


def test_revoke_without_agents_fails(rig: Rig):
    rig.keys.authority("test").enrol_with_key("operator", "bob")
    done = rig.pancakes("keys", "revoke", "bob", "laptop stolen", "--yes")
    assert done.returncode == 1 and "no agent has the roster" in done.stderr
    signed = rig.pancakes("keys", "sign")
    assert signed.returncode == 0 and "no agent has the roster" in signed.stderr
    named = rig.pancakes("keys", "sign", "--at", "127.0.0.1:1")
    assert named.returncode == 1 and "127.0.0.1:1" in named.stderr


def full_disk(folder: Path) -> bool:
    """Move a folder to a full disk; return whether that was possible."""
    files = {path.name: path.read_bytes() for path in folder.iterdir()}
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=20k,mode=700", "tmpfs", str(folder)]).returncode:
        return False
    for name, data in files.items():
        write_private(folder / name, data)
    with suppress(OSError), open(folder / "rest", "wb", 0) as rest:
        while rest.write(bytes(512)):
            pass
    return True


def test_unstored_roster_is_applied_and_reported(rig: Rig):
    rig.keys.authority("test").enrol_with_key("operator", "bob")
    folder = rig.keys.of_agent("test", "a")
    if not full_disk(folder):
        pytest.skip("a small disk can be had by root only")
    try:
        rig.ready("a")
        done = rig.pancakes("keys", "revoke", "bob", "laptop stolen", "--yes")
        assert done.returncode == 1, done.stdout
        assert "a applies the roster 2, but cannot store it" in done.stderr and "cannot be kept" in done.stderr
        assert "No space left on device" in findings(rig)["a"][1] and findings(rig)["a"][0] == "error"
        assert rig.listed("agent", "info", "a")[0]["roster"] == 2
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)
