"""`pancakes view`, as a person starts it."""

from __future__ import annotations

import json
import signal

from cli.processes import Rig
from web.browsing import fetched


def test_view_serves_its_page_until_stopped(rig: Rig):
    rig.ready("a")
    view = rig.run("-m", "pancakes.tools.cli.main", "view", whole=True)
    address = view.hear("the page is at ").rpartition(" ")[2]

    assert "<title>Pancakes</title>" in fetched(address)
    assert len(address.partition("#token=")[2]) >= 32
    code, took_s = view.signalled(signal.SIGINT)
    assert code == 0 and took_s < 5.0


def test_view_with_control_prints_its_token_as_json(rig: Rig):
    rig.ready("a")
    view = rig.run("-u", "-m", "pancakes.tools.cli.main", "view", "--control", "--format", "json", whole=True)
    view.hear("]")

    (printed,) = json.loads("\n".join(view.said))
    assert printed["control"] is True
    assert len(printed["address"].partition("#token=")[2]) >= 32


def test_view_names_the_extra_if_its_library_is_missing(rig: Rig):
    rig.ready("a")
    (rig.plugins / "websockets").mkdir()
    (rig.plugins / "websockets" / "__init__.py").write_text("raise ModuleNotFoundError(name='websockets')")
    ended = rig.pancakes("view")

    assert ended.returncode == 1
    assert "pip install 'pancakes-agents[web]'" in ended.stderr


def test_view_needs_agents_of_one_fleet(rig: Rig):
    """Without agents there is nothing to show, and of several fleets one has to be named."""
    assert rig.pancakes("view").returncode == 3
    rig.ready("a", fleet="one")
    rig.ready("b", fleet="two")
    ended = rig.pancakes("view")

    assert ended.returncode == 1
    assert "one, two" in ended.stderr and "--fleet" in ended.stderr
