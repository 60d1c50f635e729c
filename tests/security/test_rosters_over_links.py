"""Rosters between agents with keys: given to those that know less, checked, kept, and obeyed at once."""

from __future__ import annotations

import datetime
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from msgspec.structs import replace
from net.conftest import Agent, BarePeer, TlsRig

from pancakes.mesh.codec import encode_link_message
from pancakes.mesh.links import Links
from pancakes.mesh.messages import RosterNumber, RosterText
from pancakes.mesh.trust import MOST_CHECKS, keep
from pancakes.security.authority import Authority, new_key, pem_of_key
from pancakes.security.key_store import KEY, write_private
from pancakes.security.keys import Keys
from pancakes.security.roster import FALSE, LATEST_S, MOST_BYTES, Roster, read_signed
from pancakes.util.clock import wall_ns


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[TlsRig]:
    made = TlsRig(tmp_path)
    yield made
    made.close()


def two(rig: TlsRig) -> tuple[Agent, Agent]:
    a = rig.agent("a")
    b = rig.agent("b", [a.address])
    rig.until(lambda: a.knows("b") and b.knows("a"))
    return a, b


def keys_of(rig: TlsRig, agent: Agent):
    keys = rig.keys_of(agent.transport)
    assert keys is not None
    return keys


def number_of(rig: TlsRig, agent: Agent) -> int:
    return keys_of(rig, agent).roster.number


def newer(rig: TlsRig, *revoked: str) -> Roster:
    """Sign a newer roster, which no agent has heard of yet."""
    for name in revoked:
        rig.authority.revoke(name, "lost")
    return rig.authority.sign()


def test_a_newcomer_brings_the_roster_and_it_goes_from_peer_to_peer(rig):
    a = rig.agent("a")
    b = rig.agent("b", [a.address])
    c = rig.agent("c", [b.address])
    rig.until(lambda: all(len(it.mesh.connected()) == 2 for it in (a, b, c)))
    new = newer(rig)
    rig.agent("z", [c.address])
    rig.until(lambda: {number_of(rig, it) for it in (a, b, c)} == {new.number})
    kept = (keys_of(rig, a).folder / "roster.json").read_bytes()
    assert read_signed(kept)[1] == new
    assert f"the roster {new.number} of default: 0 revoked" in a.log("info")


def test_an_agent_that_is_given_a_roster_tells_others_of_it_at_once(rig, monkeypatch):
    monkeypatch.setattr("pancakes.mesh.trust.LOOK_S", 600.0)
    a, b = two(rig)
    peer = speaks(rig, a)
    new = newer(rig)
    peer.send(encode_link_message(RosterText((rig.directory / "authority" / "roster.json").read_bytes())))
    rig.until(lambda: number_of(rig, b) == new.number)


def test_a_revoked_peer_loses_its_links_and_gets_no_others(rig):
    a, b = two(rig)
    number = newer(rig, "b").number
    rig.agent("z", [a.address])
    rig.until(lambda: a.downs and b.downs)
    why = f"its certificate was revoked (roster {number}): agent/b: lost"
    assert why in a.downs[0][1] and why in b.downs[0][1]
    rig.until(lambda: "no link over" in b.log("warning"))
    assert why in b.log("warning"), "it is told why"
    assert not a.knows("b")


def test_an_agent_that_hears_that_it_was_revoked_says_so(rig):
    a = rig.agent("a")
    peer = speaks(rig, a)
    number = newer(rig, "a").number
    peer.send(encode_link_message(RosterText((rig.directory / "authority" / "roster.json").read_bytes())))
    rig.until(lambda: a.log("error"))
    why = f"its certificate was revoked (roster {number}): agent/a: lost"
    assert f"no agent of default believes this one any more: {why}" in a.log("error")


def test_what_came_over_a_link_that_has_ended_since_has_no_more_rights(rig, monkeypatch):
    """A command may wait for its turn while its link ends, and be looked at before the link is cleared away."""
    a = rig.agent("a")
    peer = speaks(rig, a)
    refused = a.access.fault("y", "end", "a")
    assert "it lacks the right 'end' on 'a'" in refused
    asked = []
    remove = Links.remove

    def removing(links, session):
        asked.append(a.access.fault("y", "end", "a"))
        remove(links, session)

    monkeypatch.setattr(Links, "remove", removing)
    peer.connection.close("it goes")
    rig.until(lambda: a.downs)
    assert asked == [refused]
    assert a.access.fault("y", "end", "a") == "a has no link to y any more, so the rights of y are not known"


class Held:
    """Take the place of the check of a signature, and says nothing until it may."""

    def __init__(self, rig: TlsRig) -> None:
        self._rig = rig
        self.may = threading.Event()
        self.begun: list[bytes] = []

    def __call__(self, keys: Keys, text: bytes) -> tuple[str, int]:
        self.begun.append(text)
        self._rig.note()
        assert self.may.wait(20.0)
        return "it was held", 1


def test_of_each_peer_one_roster_is_checked_at_a_time_and_of_all_so_many(rig, monkeypatch):
    held = Held(rig)
    monkeypatch.setattr("pancakes.mesh.trust.keep", held)
    a = rig.agent("a")
    peers = [speaks(rig, a, f"y{number}") for number in range(MOST_CHECKS + 1)]
    texts = [signed(rig.directory / "authority", number=number) for number in range(90, 99)]
    for peer, text in zip(peers, texts, strict=False):
        given = [encode_link_message(RosterText(it)) for it in (text, texts[-1])]
        peer.send(*given, encode_link_message(RosterNumber(1)))
        rig.until(lambda heard=peer.rosters: heard)  # so all that was given before was looked at
    rig.until(lambda: len(held.begun) >= MOST_CHECKS)
    assert len(held.begun) == MOST_CHECKS and set(held.begun) < set(texts[: MOST_CHECKS + 1])  # links have no order
    held.may.set()
    rig.until(lambda: a.log("warning").count("gave a roster that is not taken: it was held") == MOST_CHECKS)


def test_an_older_roster_and_the_same_change_nothing(rig):
    a, b = two(rig)
    old = (keys_of(rig, a).folder / "roster.json").read_bytes()
    new = newer(rig)
    z = rig.agent("z", [a.address])
    rig.until(lambda: number_of(rig, a) == number_of(rig, b) == new.number)
    z.mesh.stop()
    peer = speaks(rig, a)
    peer.send(encode_link_message(RosterText(old)), encode_link_message(RosterNumber(1)))
    rig.until(lambda: peer.rosters)
    assert read_signed(peer.rosters[0])[1] == new, "the peer that says that it knows less is given it"
    assert number_of(rig, a) == new.number and peer.over is None


def test_an_older_roster_that_comes_is_not_even_checked(rig):
    a = rig.agent("a")
    old = keys_of(rig, a).roster_text
    newer(rig)
    new = rig.agent("n", [a.address])
    rig.until(lambda: number_of(rig, a) == number_of(rig, new) > read_signed(old)[1].number)
    peer = speaks(rig, a)
    peer.send(encode_link_message(RosterText(old)), encode_link_message(RosterNumber(1)))
    rig.until(lambda: peer.rosters)
    assert a.log("warning") == "", "it is usual that another peer was faster"


def test_of_two_rosters_that_are_checked_at_once_the_later_one_stays(rig):
    folder = rig.enrol("a")
    keys, old = Keys(folder), signed(rig.directory / "authority", number=90)
    new = signed(rig.directory / "authority", number=91)
    assert keep(keys, new) == keep(keys, old) == ("", 0)
    assert read_signed((folder / "roster.json").read_bytes())[1].number == 91
    assert keys.learn(read_signed(new)[1], new)
    assert not keys.learn(read_signed(old)[1], old)
    assert keys.roster_text == new


class Given(BarePeer):
    """A member of the fleet that keeps what rosters it is given."""

    def __init__(self, *arguments, **more) -> None:
        super().__init__(*arguments, **more)
        self.rosters: list[bytes] = []
        self.numbers: list[int] = []

    def act(self, actions) -> None:
        for action in actions:
            message = getattr(action, "message", None)
            if isinstance(message, RosterText):
                self.rosters.append(message.text)
            elif isinstance(message, RosterNumber):
                self.numbers.append(message.number)
        super().act(actions)


def speaks(rig: TlsRig, a: Agent, name: str = "y") -> Given:
    peer = Given(rig.clock.now, name)
    rig.transport(name).dial(a.address, peer)
    rig.until(lambda: peer.is_up)
    return peer


def reason_of(rig: TlsRig, peer: BarePeer) -> str:
    """Wait for the end of a link; returns why it ended."""
    rig.until(lambda: peer.over)
    assert peer.over is not None
    return peer.over.reason


def signed(folder: Path, **more) -> bytes:
    values = {"fleet": "default", "number": 90, "signed_s": wall_ns() / 1e9, **more}
    return Authority(folder).signed(Roster(**values))


def test_a_roster_that_another_authority_has_signed_ends_the_link(rig):
    a = rig.agent("a")
    before = number_of(rig, a)
    Authority.founded("default", rig.directory / "elsewhere")
    peer = speaks(rig, a)
    peer.send(encode_link_message(RosterText(signed(rig.directory / "elsewhere"))))
    why_ended = reason_of(rig, peer)
    assert "the roster 90 was not signed by the authority of the fleet default" in why_ended
    assert number_of(rig, a) == before
    assert read_signed((keys_of(rig, a).folder / "roster.json").read_bytes())[1].number == before


@pytest.mark.parametrize(
    ("old", "new"), [(b'\\"number\\":90', b'\\"number\\":91'), (b'\\"revoked\\":[]', b'\\"revoked\\":[ ]')]
)
def test_a_roster_that_was_changed_ends_the_link(rig, old, new):
    a = rig.agent("a")
    text = signed(rig.directory / "authority")
    assert old in text
    peer = speaks(rig, a)
    peer.send(encode_link_message(RosterText(text.replace(old, new))))
    why_ended = reason_of(rig, peer)
    assert "was not signed by the authority" in why_ended and number_of(rig, a) < 90


def test_peers_are_told_the_number_again_and_again(rig, monkeypatch):
    """One whose roster could not be looked at just then gives it once more."""
    monkeypatch.setattr("pancakes.mesh.trust.LOOK_S", 0.05)
    a = rig.agent("a")
    peer = speaks(rig, a)
    rig.until(lambda: len(peer.numbers) > 2)
    assert set(peer.numbers) == {number_of(rig, a)}


def test_what_is_no_roster_ends_the_link(rig):
    a = rig.agent("a")
    peer = speaks(rig, a)
    peer.send(encode_link_message(RosterText(b"{}")))
    why_ended = reason_of(rig, peer)
    assert "the roster that it gave cannot be read" in why_ended


def test_a_roster_of_a_far_day_is_taken_only_where_the_operator_says_so(rig):
    a = rig.agent("a")
    far_s = wall_ns() / 1e9 + LATEST_S + 86_400
    peer = speaks(rig, a)
    peer.send(encode_link_message(RosterText(signed(rig.directory / "authority", signed_s=far_s))))
    rig.until(lambda: "is dated 31 days after the last one and the own clock" in a.log("warning"))
    assert number_of(rig, a) < 90 and peer.over is None
    forced = signed(rig.directory / "authority", signed_s=far_s, forced=True)
    peer.send(encode_link_message(RosterText(forced)))
    rig.until(lambda: number_of(rig, a) == 90)


def test_a_roster_of_another_fleet_is_not_taken_whoever_has_signed_it(rig):
    a = rig.agent("a")
    peer = speaks(rig, a)
    peer.send(encode_link_message(RosterText(signed(rig.directory / "authority", fleet="barn"))))
    rig.until(lambda: "the roster 90 is of the fleet barn, but this is default" in a.log("warning"))
    assert number_of(rig, a) < 90 and peer.over is None


def test_what_checks_a_roster_reads_no_more_than_one_may_have(rig):
    a = rig.agent("a")
    command = [sys.executable, "-m", "pancakes.security.check_roster", str(keys_of(rig, a).folder)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as checks:
        assert checks.stdin is not None and checks.stderr is not None
        checks.stdin.write(b" " * (MOST_BYTES + 1))
        checks.stdin.flush()  # and more may come
        try:
            assert checks.wait(20.0) == FALSE
            assert checks.stderr.read() == b"it has 131073 bytes, but at most 131072 are allowed\n"
        finally:
            checks.kill()


def test_where_a_roster_cannot_be_checked_the_link_stays(rig, monkeypatch):
    a = rig.agent("a")
    peer = speaks(rig, a)
    monkeypatch.setattr("sys.executable", "/nonexistent/python")
    peer.send(encode_link_message(RosterText(signed(rig.directory / "authority"))))
    rig.until(lambda: "its signature cannot be checked" in a.log("warning"))
    assert number_of(rig, a) < 90 and peer.over is None


def test_a_person_whose_time_is_over_is_refused_and_told(rig):
    a = rig.agent("a")
    folder = rig.enrol("alice", "operator", days=-1)
    here = rig.ear()
    rig.with_keys(folder).dial(a.address, here)
    rig.until(lambda: here.closed_for)
    assert here.data and b"its certificate ended 24.0 hours ago" in here.data


def test_a_person_whose_time_ends_while_the_link_stands_loses_it(rig, monkeypatch):
    monkeypatch.setattr("pancakes.mesh.trust.LOOK_S", 0.05)
    a = rig.agent("a")
    peer = BarePeer(rig.clock.now, "alice.1", role="client")
    rig.with_keys(rig.enrol("alice", "operator", days=1)).dial(a.address, peer)
    b = rig.agent("b", [a.address])
    rig.until(lambda: peer.is_up and a.knows("alice.1", "b") and b.knows("a"))
    monkeypatch.setattr("pancakes.security.keys.wall_ns", lambda: wall_ns() + 2 * 86_400 * 10**9)
    why_ended = reason_of(rig, peer)
    assert "alice.1 is not believed any more: its certificate ended 24.0 hours ago" in why_ended
    # The certificates of machines have no end. On a slow machine their link may have been silent, and made again.
    rig.until(lambda: a.knows("b") and b.knows("a"))


def test_a_person_whose_time_was_over_a_minute_ago_comes_in(rig):
    """The clocks of two machines may differ by five minutes, so OpenSSL is not asked."""
    a = rig.agent("a")
    here = rig.ear()
    rig.with_keys(rig.enrol("alice", "operator", days=-60 / 86_400)).dial(a.address, here)
    rig.until(lambda: here.connection)
    assert here.closed_for == []


def test_a_certificate_that_has_not_begun_shows_that_the_clock_is_late_and_is_believed(rig):
    a = rig.agent("a")
    folder, key = rig.enrol("b"), new_key()
    later = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=400)
    issued = x509.load_pem_x509_certificate((folder / KEY).read_bytes())
    locked = (rig.directory / "authority" / "authority.key").read_bytes()
    authority = serialization.load_pem_private_key(locked, None)
    assert isinstance(authority, ec.EllipticCurvePrivateKey)
    extensions = [(it.value, it.critical) for it in issued.extensions]
    built = x509.CertificateBuilder(
        issued.issuer, issued.subject, key.public_key(), 77, later, issued.not_valid_after_utc
    )
    for value, critical in extensions:
        built = built.add_extension(value, critical)
    pem = built.sign(authority, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)
    write_private(folder / KEY, pem + pem_of_key(key))
    here = rig.ear()
    rig.with_keys(folder).dial(a.address, here)
    rig.until(lambda: here.connection)
    assert here.closed_for == []


@pytest.mark.parametrize("now_ns", [0, 4_070_908_800 * 10**9], ids=["1970", "2099"])
def test_whatever_the_clock_says_machines_get_their_links(rig, monkeypatch, now_ns):
    monkeypatch.setattr("pancakes.security.keys.wall_ns", lambda: now_ns)
    two(rig)


@pytest.mark.parametrize(
    ("now_ns", "days", "told"),
    [
        (0, 90, b""),
        (0, -1, b"its certificate ended"),  # the roster is newer than that, whatever the clock says
        (4_070_908_800 * 10**9, 90, b"its certificate ended"),
    ],
)
def test_the_time_of_a_person_is_over_where_the_clock_or_the_roster_says_so(rig, monkeypatch, now_ns, days, told):
    monkeypatch.setattr("pancakes.security.keys.wall_ns", lambda: now_ns)
    a = rig.agent("a")
    here = rig.ear()
    rig.with_keys(rig.enrol("alice", "operator", days=days)).dial(a.address, here)
    rig.until(lambda: here.closed_for if told else here.connection)
    assert told in here.data and bool(here.closed_for) == bool(told)


def test_one_fleet_does_not_believe_another_of_the_same_authority(rig):
    a = rig.agent("a")
    authority, key = Authority(rig.directory / "authority"), new_key()
    authority.fleet = "other"  # as one would that signs for two fleets
    folder = rig.enrol("b")
    write_private(folder / KEY, authority.certify(key.public_key(), "agent", "b").pem + pem_of_key(key))
    here = rig.ear()
    rig.with_keys(folder).dial(a.address, here)
    rig.until(lambda: here.closed_for)
    assert "its certificate is of the fleet default, but ours of other" in here.closed_for[0]


@pytest.mark.parametrize(
    ("enrolled", "name", "role", "why"),
    [
        (("b", "agent"), "c", "agent", "it calls itself c, but its certificate is b's (agent)"),
        (("b", "agent"), "b", "environment", "b comes as environment, but its certificate is for the role agent"),
        (("alice", "operator"), "alice", "client", "it calls itself alice, but its certificate is alice's (operator)"),
        (("alice", "observer"), "alice.1", "agent", "'alice.1' is not a name"),
        (("alice", "observer"), "bob.1", "client", "it calls itself bob.1, but its certificate is alice's (observer)"),
    ],
)
def test_a_hello_must_be_as_the_certificate_says(rig, enrolled, name, role, why):
    a = rig.agent("a")
    peer = BarePeer(rig.clock.now, "b")
    peer.own = replace(peer.own, name=name, role=role)
    rig.with_keys(rig.enrol(*enrolled)).dial(a.address, peer)
    why_ended = reason_of(rig, peer)
    assert why in why_ended or why in a.log("warning")
    assert not a.ups and peer.link.peer is None, "it is told nothing of the agent"
