"""An agent that runs finds its new key, and its links are made anew with that."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from net.conftest import TlsRig

from pancakes.security.key_store import FLEET, write_private


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[TlsRig]:
    made = TlsRig(tmp_path)
    yield made
    made.close()


def test_only_a_key_of_its_own_is_a_new_one(rig: TlsRig) -> None:
    """The files of a key folder are written one after the other, and the agent may look in between."""
    keys = rig.keys_of(rig.agent("a").transport)
    assert keys is not None
    write_private(keys.folder / FLEET, (keys.folder / FLEET).read_bytes())
    assert not keys.reload(dry_run=True) and not keys.reload()
    rig.authority.enrol_with_key("agent", "a").write(keys.folder)
    assert keys.reload(dry_run=True) and keys.reload() and not keys.reload()


def test_an_agent_looks_again_and_again_whether_there_is_a_new_key_of_its_own(
    rig: TlsRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pancakes.mesh.trust.KEY_RELOAD_S", 0.05)
    a = rig.agent("a")
    b = rig.agent("b", [a.address])
    rig.until(lambda: a.knows("b") and b.knows("a"))
    keys = rig.keys_of(a.transport)
    assert keys is not None
    first = keys.own
    rig.authority.enrol_with_key("agent", "c").write(keys.folder)
    rig.until(lambda: "the old one, of a, stays in use" in a.log("warning"))
    assert a.downs == [] and keys.own == first
    rig.authority.enrol_with_key("agent", "a").write(keys.folder)
    rig.until(lambda: a.downs and b.downs)
    rig.until(lambda: a.knows("b") and b.knows("a"))
    assert keys.own.name == "a" and keys.own.serial != first.serial
