"""What the authority of a fleet signs, and what it refuses to sign."""

from __future__ import annotations

from pathlib import Path

import pytest
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from pancakes.errors import PancakesError
from pancakes.security.authority import AUTHORITY, Authority, signed_by
from pancakes.security.key_store import FLEET, ROSTER
from pancakes.security.roster import LATEST_S, Revoked, Roster, SignedRoster, read_signed
from pancakes.util.clock import wall_ns


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return Authority.founded("garage", tmp_path)


def test_a_fleet_has_one_authority(authority: Authority):
    key = (authority.folder / AUTHORITY).read_bytes()
    with pytest.raises(PancakesError, match="the fleet garage has its authority in .* already"):
        Authority.founded("garage", authority.folder)
    assert (authority.folder / AUTHORITY).read_bytes() == key


def test_a_name_is_given_out_once_until_it_is_revoked(authority: Authority):
    authority.enrol_with_key("agent", "r1")
    with pytest.raises(PancakesError, match="agent/r1 belongs to the fleet garage already: renew it with"):
        authority.check_new("r1")
    authority.check_new("r2")
    authority.revoke("r1", "lost")
    authority.check_new("r1")


def test_what_has_no_certificate_is_not_revoked(authority: Authority):
    number = read_signed((authority.folder / ROSTER).read_bytes())[1].number
    with pytest.raises(PancakesError, match="the register of the fleet garage has no r9: see pancakes keys list"):
        authority.revoke("r9", "lost")
    assert read_signed((authority.folder / ROSTER).read_bytes())[1].number == number
    authority.enrol_with_key("agent", "r1")
    number = read_signed((authority.folder / ROSTER).read_bytes())[1].number
    with pytest.raises(PancakesError, match="a revocation needs a reason"):
        authority.revoke("r1", " ")
    assert read_signed((authority.folder / ROSTER).read_bytes())[1].number == number


@pytest.mark.parametrize("days", [-31, 31])
def test_a_roster_is_not_signed_by_a_clock_that_is_far_from_the_last_one(
    authority: Authority, monkeypatch: pytest.MonkeyPatch, days: int
):
    elsewhere = wall_ns() + days * 86_400 * 10**9
    monkeypatch.setattr("pancakes.security.authority.wall_ns", lambda: elsewhere)
    assert abs(days) * 86_400 > LATEST_S
    with pytest.raises(PancakesError, match=r"the last roster was signed on .*, and by the clock .*\. Set that clock"):
        authority.sign()
    assert authority.sign(force=True).forced


def test_a_roster_has_its_bounds(authority: Authority):
    many = tuple(Revoked(f"{number:040X}", "agent/r1", "lost" * 70) for number in range(400))
    with pytest.raises(PancakesError, match="at most 131072 may be: too many certificates are revoked"):
        Authority(authority.folder).signed(Roster("garage", 9, 0.0, many))


def test_a_signature_of_the_authority_over_something_else_is_none_of_a_roster(authority: Authority):
    signed, _ = read_signed((authority.folder / ROSTER).read_bytes())
    assert signed_by(authority.folder / FLEET, signed)
    key = serialization.load_pem_private_key((authority.folder / AUTHORITY).read_bytes(), None)
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    bare = key.sign(signed.payload.encode(), ec.ECDSA(hashes.SHA256()))
    assert not signed_by(authority.folder / FLEET, SignedRoster(signed.payload, bare.hex()))
