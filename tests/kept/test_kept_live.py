"""What earlier versions have left, taken up by agents on threads; and pictures of a recording, which take long."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from kept.conftest import Kept
from kept.make import CLASSES, FLEET
from kept.test_kept_state import began

from pancakes.control import Describe
from pancakes.journal import FileJournal
from pancakes.testing import AgentHandle, threaded_agent
from pancakes.tools.cli.main import pancakes


def test_kept_state_directory_of_a_killed_agent_is_taken_up(kept: Kept):
    """A journal on a true disk, with a write-ahead file. It was copied, which the agent knows and says."""
    state = kept.folder / "agent" / "state"
    expected = kept.expected["agent"]["Count"]
    text = (kept.folder / "agent" / "alone.toml").read_text()
    with threaded_agent("alone", text, classes=CLASSES, state_dir=state) as agent:
        assert expected.pop("agent") == "alone" and began(agent, "Count") == expected
        assert agent.ask(Describe("Stopped")).result["state"] == "stopped"
        assert agent.lines("error") == []
    journal = FileJournal(state)
    assert journal.boot == 3 and journal.set_aside == () and journal.missing == ()
    journal.close()


def agent(name: str, keys: Path, **more: Any) -> Any:
    network = {"network": {"settings": {"keys": str(keys / name)}}}
    return threaded_agent(name, services=network, fleet=FLEET, listen="tcp://127.0.0.1:0", **more)


def address(agent: AgentHandle) -> str:
    (found,) = [it for it in agent.ask(Describe()).result["listen"] if it.startswith("tcp://")]
    return found


def test_kept_keys_let_an_agent_join(kept: Kept):
    keys = kept.folder / "keys"
    with agent("a", keys) as a, agent("b", keys, peers=(address(a),)) as b:
        b.wait_until(lambda: b.agent.mesh.connected() and a.agent.mesh.connected())
        assert not a.lines("warning") and not b.lines("warning")


def test_kept_recording_is_reported(kept: Kept, request: pytest.FixtureRequest):
    if "now" in request.node.name:
        pytest.skip("report/ has the tests of reports of this version, and pictures take long")
    pytest.importorskip("matplotlib")
    result = CliRunner().invoke(pancakes, ["report", "recording", "--out", "report"])
    assert result.exit_code == 0, result.output
    assert json.loads((kept.folder / "report" / "report.json").read_text())
    assert "Drive" in (kept.folder / "report" / "report.html").read_text()
