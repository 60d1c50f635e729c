"""Whom a roster and a clock let in, as tables."""

from __future__ import annotations

import json
import math

import pytest
from seeded import for_each

from pancakes.security.roster import (
    LATEST_S,
    MOST_BYTES,
    NEVER_S,
    Certified,
    Revoked,
    Roster,
    certified,
    fault_of_bearer,
    fault_of_certified,
    fault_of_news,
    read_signed,
)

DAY_S = 86_400.0
NOW_S = 1_795_000_000.0  # November 2026
LATE_S, EARLY_S = 4_080_000_000.0, 100.0  # 2099 and 1970
ROBOT = Certified("garage", "agent", "r1", (), "A1", math.inf)
PERSON = Certified("garage", "operator", "alice", (), "B2", NOW_S)
GONE = Certified("garage", "operator", "bob", (), "C3", NOW_S - 10 * DAY_S)
LOST = Certified("garage", "agent", "r2", (), "D4")
ROSTER = Roster("garage", 7, NOW_S - DAY_S, (Revoked("D4", "agent/r2", "lost"),))


def test_roster_and_clock_decisions():
    def check(case):
        shown, now_s, fault = case
        assert fault_of_certified(shown, "garage", ROSTER, now_s) == fault

    for_each(
        [
            (ROBOT, NOW_S, ""),
            (ROBOT, EARLY_S, ""),
            (ROBOT, LATE_S, ""),
            (PERSON, NOW_S, ""),
            (PERSON, NOW_S + 299.0, ""),
            (PERSON, NOW_S + 3601.0, "its certificate ended 1.0 hours ago"),
            (PERSON, EARLY_S, ""),
            (PERSON, LATE_S, "its certificate ended 26447 days ago"),
            (GONE, EARLY_S, "its certificate ended 9 days ago"),  # the roster was signed after its end
            (
                Certified("garage", "agent", "r2", (), "D4"),
                EARLY_S,
                "its certificate was revoked (roster 7): agent/r2: lost",
            ),
            (Certified("barn", "agent", "r1"), NOW_S, "its certificate is of the fleet barn, but ours of garage"),
        ],
        check,
    )


def test_without_a_roster_the_clock_alone_counts():
    assert fault_of_certified(GONE, "garage", None, EARLY_S) == ""
    assert fault_of_certified(GONE, "garage", None, NOW_S) == "its certificate ended 10 days ago"


def test_roster_choice():
    def check(case):
        new, last, now_s, fault = case
        found = fault_of_news(new, last, "garage", now_s)
        assert fault in found and bool(found) is bool(fault)

    for_each(
        [
            (Roster("garage", 8, NOW_S), ROSTER, NOW_S, ""),
            (Roster("garage", 1, NOW_S), None, NOW_S, ""),
            (Roster("garage", 7, NOW_S), ROSTER, NOW_S, "the roster 7 is older than the roster 7, which is in use"),
            (Roster("garage", 6, NOW_S), ROSTER, NOW_S, "the roster 6 is older than the roster 7, which is in use"),
            (Roster("barn", 8, NOW_S), ROSTER, NOW_S, "the roster 8 is of the fleet barn, but this is garage"),
            (Roster("garage", 8, NOW_S + LATEST_S - DAY_S + 1), ROSTER, EARLY_S, "is dated 30 days after"),
            (Roster("garage", 8, NOW_S + LATEST_S - DAY_S), ROSTER, EARLY_S, ""),
            (Roster("garage", 8, LATE_S), ROSTER, NOW_S, "sign it with pancakes keys sign --any-date"),
            (Roster("garage", 8, LATE_S, forced=True), ROSTER, NOW_S, ""),
            (Roster("garage", 8, LATE_S), ROSTER, LATE_S, ""),
            (Roster("garage", 8, EARLY_S), ROSTER, NOW_S, ""),
        ],
        check,
    )


@pytest.mark.parametrize("text", [b"", b"{}", b"[]", b'{"payload": "{}", "signature": ""}'])
def test_what_is_no_roster(text):
    with pytest.raises(ValueError, match="it is not a roster"):
        read_signed(text)


def test_a_roster_is_no_larger_than_what_may_travel():
    sound = json.dumps({"payload": '{"fleet": "garage", "number": 1, "signed_s": 0.0}', "signature": ""}).encode()
    assert read_signed(sound.ljust(MOST_BYTES))[1].fleet == "garage"
    with pytest.raises(ValueError, match="it has 131073 bytes, but at most 131072 are allowed"):
        read_signed(sound.ljust(MOST_BYTES + 1))


def test_bearer_of_a_certificate():
    def check(case):
        shown, name, role, fleet, fault = case
        assert fault_of_bearer(shown, name, role, fleet) == fault

    for_each(
        [
            (ROBOT, "r1", "agent", "garage", ""),
            (PERSON, "alice.4f", "client", "garage", ""),
            (ROBOT, "r1x", "agent", "garage", "it calls itself r1x, but its certificate is r1's (agent)"),
            (
                ROBOT,
                "r1",
                "environment",
                "garage",
                "r1 comes as environment, but its certificate is for the role agent",
            ),
            (ROBOT, "r1", "agent", "barn", "r1 says that it is of the fleet barn, but its certificate says garage"),
            (PERSON, "alice", "client", "garage", "it calls itself alice, but its certificate is alice's (operator)"),
            (
                PERSON,
                "alicex.1",
                "client",
                "garage",
                "it calls itself alicex.1, but its certificate is alice's (operator)",
            ),
        ],
        check,
    )


def shown(*uris):
    return {"serialNumber": "A1", "subjectAltName": tuple(("URI", uri) for uri in uris)}


def test_a_certificate_says_who_and_in_which_groups_of_its_fleet():
    uris = ("pancakes://garage/agent/r1", "pancakes://garage/group/field", "pancakes://barn/group/staff")
    assert certified(shown(*uris), 5.0) == Certified("garage", "agent", "r1", ("field",), "A1", 5.0)
    assert certified(shown(*uris), NEVER_S).ends_s == math.inf


@pytest.mark.parametrize(
    "uris",
    [
        (),
        ("pancakes://garage/group/field",),
        ("pancakes://garage/agent/r1", "pancakes://garage/operator/alice"),
        ("pancakes://garage/agent/r1", "pancakes://barn/agent/r1"),
        ("pancakes://garage/king/r1",),
        ("pancakes://garage/agent/r1/x",),
    ],
)
def test_a_certificate_that_names_not_one_agent_or_person_is_none_of_ours(uris):
    with pytest.raises(ValueError, match=r"its certificate names [02] agents or people, and not one"):
        certified(shown(*uris), 5.0)
