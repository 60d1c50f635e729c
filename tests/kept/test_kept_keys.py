"""Keys, certificates and rosters of earlier versions: their agents are still let in, and those revoked are not."""

from __future__ import annotations

from pathlib import Path

import pytest
from cryptography import x509
from kept.conftest import Kept
from kept.make import LONG_AGO_NS

from pancakes.security.authority import Authority
from pancakes.security.key_store import FLEET as AUTHORITY_FILE
from pancakes.security.key_store import KEY, ROSTER
from pancakes.security.keys import Keys


@pytest.fixture
def keys(kept: Kept) -> Path:
    return kept.folder / "keys"


def test_kept_certificates_of_agents_never_end(keys: Path):
    for file in (keys / "a" / KEY, keys / "b" / KEY, keys / "a" / AUTHORITY_FILE):
        assert x509.load_pem_x509_certificate(file.read_bytes()).not_valid_after_utc.year == 9999


def test_kept_certificate_of_a_person_has_ended(keys: Path, monkeypatch: pytest.MonkeyPatch):
    a, alice = Keys(keys / "a"), Keys(keys / "alice")
    assert "its certificate ended" in a.fault_of(alice.own)
    monkeypatch.setattr("time.time_ns", lambda: LONG_AGO_NS)
    assert a.fault_of(alice.own) == ""


def test_kept_roster_revokes_an_agent(keys: Path):
    a = Keys(keys / "a")
    assert a.fault_of(Keys(keys / "b").own) == ""
    assert "was revoked" in a.fault_of(Keys(keys / "lost").own)
    assert a.roster is not None and [rule.who for rule in a.roster.allow][-1] == ("alice",)


def test_kept_authority_enrols_and_signs(keys: Path, monkeypatch: pytest.MonkeyPatch):
    authority = Authority(keys / "authority")
    assert [it.name for it in authority.entries] == ["a", "b", "lost", "alice"]
    authority.enrol_with_key("agent", "c").write(keys / "c")
    a, new = Keys(keys / "a"), authority.sign(force=True)
    assert a.learn(new, (keys / "authority" / ROSTER).read_bytes()) and a.fault_of(Keys(keys / "c").own) == ""
