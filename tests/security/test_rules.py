"""What rules allow, as tables."""

from __future__ import annotations

import weakref

import pytest
from seeded import for_each

from pancakes.control import CONTROLS, Describe, Shutdown, Stop
from pancakes.errors import PancakesError
from pancakes.packet import CTRL, LOG, NETWORK, SYSCTRL, SYSTEM, Packet
from pancakes.security.access import Access, needs, right_of
from pancakes.security.key_store import RULES, add_rule, begin_rules, read_rules
from pancakes.security.roster import DEFAULT, RIGHTS, AccessRule, Bearer, Roster, allows

R2 = Bearer("r2", "agent", ("field",))


def test_access_rule_allows_only_what_it_names():
    def check(case):
        rule, is_allowed = case
        assert allows([rule], R2, "change", ("r1/device/motors",), "r1") is is_allowed
        assert allows([], R2, "change", ("r1/device/motors",), "r1") is False

    for_each(
        [
            (AccessRule(("r2",), ("change",)), True),
            (AccessRule(("r?",), ("*",)), True),
            (AccessRule(("role:agent",), ("look", "change")), True),
            (AccessRule(("group:field",), ("change",)), True),
            (AccessRule(("r2",), ("change",), ("r1/device/*",)), True),
            (AccessRule(("r2",), ("change",), ("*",), ("r1", "r9")), True),
            (AccessRule(("r3",), ("change",)), False),
            (AccessRule(("role:operator",), ("change",)), False),
            (AccessRule(("group:staff",), ("change",)), False),
            (AccessRule(("agent",), ("change",)), False),
            (AccessRule(("field",), ("change",)), False),
            (AccessRule(("r2",), ("look",)), False),
            (AccessRule(("r2",), ("change",), ("r1/client/*",)), False),
            (AccessRule(("r2",), ("change",), ("*",), ("r9",)), False),
        ],
        check,
    )


@pytest.mark.parametrize(
    ("role", "rights"),
    [
        ("operator", RIGHTS),
        ("observer", ("look",)),
        ("agent", ("look", "host", "guard", "write", "publish", "halt")),
        ("environment", ("publish",)),
    ],
)
def test_the_rules_of_a_new_fleet(role, rights):
    who = Bearer("x", role)
    assert {right for right in RIGHTS if allows(DEFAULT, who, right, ("any",), "r1")} == set(rights)


def test_each_control_packet_needs_a_right():
    assert set(CONTROLS.values()) <= set(RIGHTS)
    assert right_of(Stop("X")) == "change" and right_of(Stop("X", dry_run=True)) == "look"
    assert right_of(Shutdown()) == "end" and right_of(Describe()) == "look"


def test_rights_that_packets_need():
    def check(case):
        channel, kind, needed = case
        assert needs(Packet(channel, kind, "r2/c/T", "r1/device/motors", 0.0, 1, None)) == needed

    for_each(
        [
            (SYSCTRL, "stop", None),
            (SYSCTRL, "reply", None),
            (SYSCTRL, "words", ("publish", (SYSCTRL,))),
            (CTRL, "velocity", ("command", ("r1/device/motors", "velocity"))),
            (NETWORK, "migration.commit", None),
            (NETWORK, "post.letter", None),
            (NETWORK, "words", ("publish", (NETWORK,))),
            (SYSTEM, "pose", ("publish", (SYSTEM,))),
            (LOG, "event", ("publish", (LOG,))),
            ("map", "words", ("publish", ("map",))),
            ("map", "stop", ("publish", ("map",))),
            ("map", "migration.commit", ("publish", ("map",))),
        ],
        check,
    )


def access(*rules: AccessRule, number: int = 7, **more) -> Access:
    made = Access("r1", lambda: Roster("garage", number, 0.0, allow=rules), **more)
    made.bearer_of = {"r2": (R2, True), "near": (Bearer("near", "operator"), False)}.get
    return made


def test_a_refusal_names_the_missing_right_and_the_command_that_grants_it():
    it = access(AccessRule(("r2",), ("look",)))
    assert it.fault("r2", "look", "r1") == ""
    assert it.fault("r2", "change", "r1/device/motors") == (
        "r1 does not let r2 (agent) do this: it lacks the right 'change' on 'r1/device/motors' (roster 7). To grant it:"
        " pancakes keys allow r2 change --on 'r1/device/motors' --agent r1"
    )


def test_an_agent_may_do_all_to_itself_and_a_peer_that_has_gone_nothing():
    it = access()
    assert it.fault("r1", "change", "r1/device/motors") == ""
    assert "has no link to r5 any more" in it.fault("r5", "look", "r1")


def test_a_new_roster_counts_at_once():
    rules: list[AccessRule] = []
    it = Access("r1", lambda: Roster("garage", len(rules) + 1, 0.0, allow=tuple(rules)))
    it.bearer_of = {"r2": (R2, True)}.get
    assert it.fault("r2", "change", "r1/x")
    rules.append(AccessRule(("r2",), ("change",)))
    assert it.fault("r2", "change", "r1/x") == ""


class Name(str):
    """A name of which one can see that it was forgotten."""


def test_a_peer_that_makes_up_names_fills_no_memory():
    roster = Roster("garage", 7, 0.0, allow=(AccessRule(("r2",), ("look",)),))
    it = Access("r1", lambda: roster)
    it.bearer_of = {"r2": (R2, True)}.get
    first = Name("r1/0")
    seen = weakref.ref(first)
    assert it.fault("r2", "look", first) == ""
    del first
    for number in range(1, 5000):
        assert it.fault("r2", "look", f"r1/{number}") == ""
    assert seen() is None


def test_rules_of_the_fleet_are_for_those_with_a_certificate():
    assert access().fault("near", "end", "r1") == "", "the kernel says that it is the agent's own user"
    own = access(own=(AccessRule(("role:operator",), ("look",)),))
    assert own.fault("near", "look", "r1") == ""
    assert "it lacks the right 'end' on 'r1' (the [access] of its own file)" in own.fault("near", "end", "r1")


def test_the_own_file_takes_rights_from_all():
    it = access(AccessRule(("*",), ("*",)), refused=("end",))
    for peer in ("r2", "near"):
        assert it.fault(peer, "end", "r1") == "r1 lets no peer do this: its own file refuses the right 'end'"
        assert it.fault(peer, "look", "r1") == ""


def test_what_others_said_needs_the_right_to_replay_and_that_to_publish():
    it = access(AccessRule(("r2",), ("publish",)))
    own, of_others = (Packet(SYSTEM, "pose", source, "r1", 0.0, 1, None) for source in ("r2/c/T", "r3/c/T"))
    assert it.fault_of_packet(R2, True, "r2", own) == ""
    assert "the right 'replay' on 'system'" in it.fault_of_packet(R2, True, "r2", of_others)


def test_the_file_of_rules_keeps_what_a_person_wrote(tmp_path):
    begin_rules(tmp_path)
    assert read_rules(tmp_path) == DEFAULT
    path = tmp_path / RULES
    path.write_text(path.read_text() + "# a remark\n")
    rule = AccessRule(("r2",), ("command", "look"), ("motors", 'a"b'), ("r1",))
    add_rule(tmp_path, rule)
    assert read_rules(tmp_path) == (*DEFAULT, rule)
    assert "# a remark" in path.read_text() and path.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[[access.allow]]\nwho = ['x']\nmay = ['fly']\n", "may[0]: expected one of 'look', 'change'"),
        ("[[access.allow]]\nwho = ['x']\n", "access.allow[0].may: is missing"),
        ("[[access.deny]]\nwho = ['x']\n", "access.deny: unknown key"),
        ("[[access.allow]]\nwho = ['x']\nmay = ['look']\nfrom = ['y']\n", "access.allow[0].from: unknown key"),
        ("[[access.allow]]\nwho = 'x'\nmay = ['look']\n", "access.allow[0].who: expected a list"),
        ("[access", "not valid"),
    ],
)
def test_a_file_that_is_not_sound_is_named(tmp_path, text, why):
    (tmp_path / RULES).write_text(text)
    with pytest.raises(PancakesError, match=r"the rules .*rules\.toml are not valid") as raised:
        read_rules(tmp_path)
    assert why in str(raised.value)
    with pytest.raises(PancakesError, match="are not valid"):
        add_rule(tmp_path, AccessRule(("r2",), ("look",)))
    assert (tmp_path / RULES).read_text() == text


def test_without_a_roster_an_agent_with_keys_lets_no_peer_do_anything():
    it = Access("r1", lambda: None)
    assert "lacks the right 'end'" in it.fault_of(R2, True, "end", ("r1",))
    assert "has no link to r2 any more" in it.fault("r2", "end", "r1")
    assert Access("r1").fault("r2", "end", "r1") == ""
