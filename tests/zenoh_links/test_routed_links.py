"""What a link through routers does where something goes wrong, and what a router can see and do."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import psutil
import pytest
import zenoh
from net.conftest import Ear
from net.test_tls import keys_of_a_stranger
from pancakes_zenoh.credit_pool import LEAST_BYTES
from pancakes_zenoh.link_frames import PIECE_BYTES, FrameKind, LinkFrame, frame_bytes, frame_of
from pancakes_zenoh.routed_link import RoutedLink
from pancakes_zenoh.router_session import session_config
from zenoh_links.routers import Router, ZenohRig, link_of

from pancakes.errors import PancakesError
from pancakes.mesh.transport import SocketTransport
from pancakes.util.plugins import Plugins

SECRET = b"the key is under the mat"


class Eavesdropper:
    """A session of none of ours at the router, where nothing keeps sessions apart: it reads and writes all keys."""

    def __init__(self, router: Router) -> None:
        self.session = zenoh.open(session_config("client", [router.address], "", "", silent_s=2.0))
        self.heard: list[tuple[str, bytes]] = []
        self.session.declare_subscriber("**", self._hear)

    def _hear(self, sample: Any) -> None:
        self.heard.append((str(sample.key_expr), sample.payload.to_bytes()))

    def everything(self) -> bytes:
        return b"".join(data for _, data in self.heard)

    def say(self, link: RoutedLink, data: bytes, space: str = "default") -> None:
        """Puts a frame to the session at the other end of a link."""
        self.session.put(f"pancakes/1/{space}/to/{link.peer}", data, congestion_control=zenoh.CongestionControl.BLOCK)


@pytest.fixture
def eavesdropper(rig: ZenohRig) -> Iterator[Eavesdropper]:
    made = Eavesdropper(rig.router)
    yield made
    made.session.close()


def joined(rig: ZenohRig) -> tuple[Ear, Ear]:
    here, there = rig.ear(), rig.ear()
    address = rig.transport("b").listen(rig.listen_at, lambda: there)
    rig.transport("a").dial(address, here)
    rig.until(lambda: here.connection and there.connection)
    return here, there


open_alone = pytest.mark.parametrize("rig", ["open"], indirect=True)
keyed_alone = pytest.mark.parametrize("rig", ["keyed"], indirect=True)


@open_alone
@pytest.mark.parametrize(
    ("kind", "offset", "data", "why"),
    [
        (FrameKind.DATA, 7, b"x", "bytes were lost on the way: those at 0 are missing"),
        (FrameKind.DATA, 0, bytes(LEAST_BYTES + 1), "4097 bytes came where 4096 were granted"),
        (FrameKind.DATA, 0, bytes(PIECE_BYTES + 1), "it has 61441 bytes of data, too many for a frame DATA"),
        (FrameKind.GRANT, 2**40, b"", "1099511627776 bytes were granted, and 0 were sent"),
        (FrameKind.GRANT, 1, b"x", "it has 1 bytes of data, too many for a frame GRANT"),
        (FrameKind.FIN, 5, b"", "bytes were lost on the way: 0 of 5 came"),
        (FrameKind.OPEN, 0, b"", "it was opened twice"),
        (77, 0, b"", "it is of the kind 77, which there is not"),
    ],
)
def test_a_frame_that_breaks_the_rules_ends_its_link_and_no_other(rig, eavesdropper, kind, offset, data, why):
    here, there = joined(rig)
    other, far = joined(rig)
    eavesdropper.say(link_of(here), frame_bytes(kind, link_of(here).number, offset, 0, data))
    rig.until(lambda: here.closed_for and there.closed_for)
    assert there.closed_for[0].startswith("the connection to") and there.closed_for[0].endswith(why)
    assert here.closed_for[0].startswith("the other side broke the connection off: ")
    assert here.closed_for[0].endswith(why) and there.data == b""
    link_of(other).send(b"goes on")
    rig.until(lambda: far.data == b"goes on")


@open_alone
@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x00",
        bytes(200_000),
        frame_bytes(FrameKind.OPEN, 1, 0, 0, b"nonsense"),
        frame_bytes(FrameKind.OPEN, 1, 0, 0, b"abc nowhere/1"),
        frame_bytes(FrameKind.DATA, 12345, 0, 0, b"of no link"),
        frame_bytes(FrameKind.BREAK, 12345, 0, 0, b"of no link"),
    ],
)
def test_what_is_about_no_link_ends_none(rig, eavesdropper, data):
    here, there = joined(rig)
    eavesdropper.say(link_of(here), data)
    link_of(here).send(b"after it")
    rig.until(lambda: there.data == b"after it")
    assert not here.closed_for and not there.closed_for


@open_alone
def test_without_keys_a_router_reads_and_says_what_it_likes(rig, eavesdropper):
    here, there = joined(rig)
    link_of(here).send(SECRET)
    rig.until(lambda: there.data == SECRET and SECRET in eavesdropper.everything())
    forged = frame_bytes(FrameKind.DATA, link_of(here).number, len(SECRET), 0, b"forged")
    eavesdropper.say(link_of(here), forged)
    rig.until(lambda: there.data == SECRET + b"forged")


@keyed_alone
def test_with_keys_a_router_reads_nothing_and_what_it_makes_up_ends_the_link(rig, eavesdropper):
    here, there = joined(rig)
    for _ in range(20):
        link_of(here).send(SECRET)
    rig.until(lambda: there.data == SECRET * 20)
    rig.until(lambda: secrets_heard(eavesdropper, here) == 20)
    assert SECRET not in eavesdropper.everything()
    last = sent_to(eavesdropper, here)[-1]
    offset = last.offset + len(last.data)
    record = b"\x17\x03\x03\x00\x20" + bytes(32)  # as TLS makes them, with a key that is none
    eavesdropper.say(link_of(here), frame_bytes(FrameKind.DATA, link_of(here).number, offset, 0, record))
    rig.until(lambda: here.closed_for and there.closed_for)
    assert there.closed_for[0].endswith("what came was changed on its way") and there.data == SECRET * 20


def sent_to(eavesdropper: Eavesdropper, ear: Ear) -> list[LinkFrame]:
    """What went to the other end of a link, as far as it was bytes of that link."""
    link = link_of(ear)
    frames = [frame_of(data) for key, data in eavesdropper.heard if key.endswith(f"to/{link.peer}")]
    return [frame for frame in frames if (frame.link, frame.kind) == (link.number, FrameKind.DATA)]


def secrets_heard(eavesdropper: Eavesdropper, ear: Ear) -> int:
    """How many records of TLS went to the other end of a link that are as long as one with the secret."""
    stream = b"".join(frame.data for frame in sent_to(eavesdropper, ear))
    return stream.count(b"\x17\x03\x03" + (len(SECRET) + 17).to_bytes(2))  # its type and its tag are encrypted with it


@keyed_alone
def test_a_frame_that_is_said_again_ends_the_link(rig, eavesdropper):
    here, there = joined(rig)
    link_of(here).send(SECRET)
    rig.until(lambda: there.data == SECRET)
    rig.until(lambda: secrets_heard(eavesdropper, here) == 1)
    again = sent_to(eavesdropper, here)[-1]
    number = link_of(here).number
    eavesdropper.say(link_of(here), frame_bytes(FrameKind.DATA, number, again.offset, 0, again.data))
    rig.until(lambda: here.closed_for and there.closed_for)
    assert "bytes were lost" in there.closed_for[0] and there.data == SECRET


@keyed_alone
def test_both_know_who_is_there_and_a_key_of_another_authority_is_refused(rig):
    here, there = joined(rig)
    answered, told = link_of(here).certified, link_of(there).certified
    assert answered and told and (answered.name, told.name) == ("b", "a")
    stranger, visited = rig.ear(), rig.ear()
    address = rig.transport("c").listen(rig.listen_at, lambda: visited)
    rig.with_keys(keys_of_a_stranger(rig)).dial(address, stranger)
    rig.until(lambda: stranger.closed_for and visited.closed_for)
    assert stranger.closed_for == ["its certificate is of another fleet"]
    assert stranger.connection is None and visited.connection is None


@open_alone
def test_no_port_of_this_machine_is_taken(rig):
    def listening() -> set[Any]:
        found = psutil.Process().net_connections("inet")
        return {it.laddr for it in found if it.status == psutil.CONN_LISTEN or not it.raddr}

    before = listening()
    joined(rig)
    assert listening() == before


@pytest.mark.parametrize(
    "address", ["zenoh://10.0.0.1:1", "zenoh://localhost:1", "zenoh://robot1", "zenoh:///robot1", "zenoh://[::1]:1"]
)
@open_alone
def test_an_address_is_a_name_and_a_number(rig, address):
    with pytest.raises(PancakesError, match="cannot listen at .*is no address|cannot listen at .*has no port"):
        rig.transport("a").listen(address, rig.ear)
    assert not rig.transport("b").may_be_named(address)


def transport_with(rig: ZenohRig, **settings: Any) -> SocketTransport:
    made = SocketTransport(rig.clock, "x", Plugins(), {"zenoh": {"insecure": True, **settings}})
    rig.transports.append(made)
    return made


@open_alone
def test_what_is_wrong_is_said_with_what_to_do(rig, tmp_path):
    without = SocketTransport(rig.clock, "x", Plugins(), {"zenoh": {"routers": ["tcp/127.0.0.1:1"]}})
    rig.transports.append(without)
    with pytest.raises(PancakesError, match=r"'zenoh://x:1' needs keys: run pancakes keys join"):
        without.listen("zenoh://x:1", rig.ear)
    with pytest.raises(PancakesError, match=r"no Zenoh router is known: name one in \[service.network\]"):
        transport_with(rig).listen("zenoh://x:1", rig.ear)
    with pytest.raises(PancakesError, match="nonsense cannot be used for Zenoh"):
        transport_with(rig, routers=["nonsense"]).listen("zenoh://x:1", rig.ear)
    with pytest.raises(PancakesError, match=r"silent_s.*>= 0.5"):
        transport_with(rig, routers=["tcp/127.0.0.1:1"], silent_s=0.1).listen("zenoh://x:1", rig.ear)
    with pytest.raises(PancakesError, match="none.json5 cannot be used for Zenoh"):
        transport_with(rig, file=str(tmp_path / "none.json5")).listen("zenoh://x:1", rig.ear)
    os.mkfifo(tmp_path / "pipe.json5")
    with pytest.raises(PancakesError, match=r"pipe\.json5 cannot be used for Zenoh: .*it is a pipe, not a file"):
        transport_with(rig, file=str(tmp_path / "pipe.json5")).listen("zenoh://x:1", rig.ear)
    ear = rig.ear()
    transport_with(rig, routers=["tcp/127.0.0.1:1"], dial_s=3).dial("zenoh://x:1", ear)
    rig.until(lambda: ear.closed_for)
    away = transport_with(rig, routers=["tcp/127.0.0.1:1"])
    away.listen("zenoh://y:1", rig.ear)
    ear = rig.ear()
    away.dial("zenoh://x:1", ear)
    rig.until(lambda: ear.closed_for)
    assert ear.closed_for[0].startswith("zenoh://x:1 cannot be reached: no router answers at tcp/127.0.0.1:1")


@open_alone
def test_a_configuration_file_of_zenohs_may_say_where_routers_are(rig, tmp_path):
    file = tmp_path / "zenoh.json5"
    file.write_text(f'{{connect: {{endpoints: ["{rig.router.address}"]}}}}')
    here, there = rig.ear(), rig.ear()
    address = transport_with(rig, file=str(file)).listen("zenoh://filed:1", lambda: there)
    rig.transport("a").dial(address, here)
    rig.until(lambda: here.connection and there.connection)
