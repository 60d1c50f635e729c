"""What the authority of a fleet signs, and what it refuses to sign."""

from __future__ import annotations

from pathlib import Path

import pytest
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from pancakes.errors import PancakesError
from pancakes.security.authority import AUTHORITY, Authority, FleetOffice, signed_by
from pancakes.security.key_store import FLEET, ROSTER
from pancakes.security.roster import LATEST_S, Revoked, Roster, SignedRoster, read_signed
from pancakes.util.clock import wall_ns


@pytest.fixture
def office(tmp_path: Path) -> FleetOffice:
    return FleetOffice.founded("garage", tmp_path)


def test_a_fleet_has_one_authority(office: FleetOffice):
    key = (office.folder / AUTHORITY).read_bytes()
    with pytest.raises(PancakesError, match="the fleet garage has its authority in .* already"):
        FleetOffice.founded("garage", office.folder)
    assert (office.folder / AUTHORITY).read_bytes() == key


def test_a_name_is_given_out_once_until_it_is_revoked(office: FleetOffice):
    office.enrol_with_key("agent", "r1")
    with pytest.raises(PancakesError, match="agent/r1 belongs to the fleet garage already: renew it with"):
        office.check_new("r1")
    office.check_new("r2")
    office.revoke("r1", "lost")
    office.check_new("r1")


def test_what_has_no_certificate_is_not_revoked(office: FleetOffice):
    number = read_signed((office.folder / ROSTER).read_bytes())[1].number
    with pytest.raises(PancakesError, match="the register of the fleet garage has no r9: see pancakes fleet list"):
        office.revoke("r9", "lost")
    assert read_signed((office.folder / ROSTER).read_bytes())[1].number == number


@pytest.mark.parametrize("days", [-31, 31])
def test_a_roster_is_not_signed_by_a_clock_that_is_far_from_the_last_one(
    office: FleetOffice, monkeypatch: pytest.MonkeyPatch, days: int
):
    elsewhere = wall_ns() + days * 86_400 * 10**9
    monkeypatch.setattr("pancakes.security.authority.wall_ns", lambda: elsewhere)
    assert abs(days) * 86_400 > LATEST_S
    with pytest.raises(PancakesError, match=r"the last roster was signed on .*, and by the clock .*\. Set that clock"):
        office.sign()
    assert office.sign(force=True).forced


def test_a_roster_has_its_bounds(office: FleetOffice):
    many = tuple(Revoked(f"{number:040X}", "agent/r1", "lost" * 70) for number in range(400))
    with pytest.raises(PancakesError, match="131072 are the most: so many are revoked that it is time for a new"):
        Authority(office.folder).signed(Roster("garage", 9, 0.0, many))


def test_a_signature_of_the_authority_over_something_else_is_none_of_a_roster(office: FleetOffice):
    signed, _ = read_signed((office.folder / ROSTER).read_bytes())
    assert signed_by(office.folder / FLEET, signed)
    key = serialization.load_pem_private_key((office.folder / AUTHORITY).read_bytes(), None)
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    bare = key.sign(signed.payload.encode(), ec.ECDSA(hashes.SHA256()))
    assert not signed_by(office.folder / FLEET, SignedRoster(signed.payload, bare.hex()))
