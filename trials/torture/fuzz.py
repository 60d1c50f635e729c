"""Fuzz an agent as a member of its fleet: send names, sources, runs and migrations that are nearly valid.

The fuzzer has keys and sends a valid hello, then frames as fast as the agent takes them. Some frames break the
protocol and so end the link; then it connects again. The agent must survive, answer its own user, and not grow.
"""

from __future__ import annotations

import contextlib
import random
import socket
import ssl
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import msgpack
import psutil
from cli.processes import Rig
from net.meetings import message_of, raw_hello

from pancakes.control import (
    Adopt,
    Configure,
    Describe,
    Follow,
    Migrate,
    Refusal,
    Reply,
    Reschedule,
    SetFence,
    Shutdown,
    Start,
    Stop,
)
from pancakes.devices import Battery, Load
from pancakes.durable.delivery import AskBegan, ForwardTo, Letter, Receipt, StreamsBegan
from pancakes.durable.messages import (
    Accept,
    Accepted,
    Bid,
    BootRemembered,
    Call,
    CanGuard,
    Fact,
    Known,
    MayGuard,
    Piece,
    Prepare,
    Promise,
    Refuse,
    Solicit,
    WhoHas,
)
from pancakes.durable.record import TaskId
from pancakes.durable.register import Epoch, Identity, Register
from pancakes.errors import RemoteProtocolError
from pancakes.events import Event, LogLine
from pancakes.mesh.codec import PacketRun, encode_link_message, frame, messages_from_payload, packets_of
from pancakes.mesh.messages import AgentSeen, Gossip, Ping, Pong, RosterNumber
from pancakes.packet import CTRL, LOG, NETWORK, SYSCTRL, SYSTEM, Packet, type_name

POOL: Final = 4096
"""How many frames are made beforehand, and then sent in random order."""
BATCH: Final = 256
"""How many frames are sent with one call."""
PATIENCE_S: Final = 30.0
MEMORY_MIB: Final = 32.0
NAMES: Final = (
    *("a", "b", "z", "", "a/client/Count", "z/client/T", "z/network/client"),
    *("task:a/Count", "*", "x" * 300, "a/../b", "ä", "\x1b[0m"),
)
ODD: Final[tuple[Any, ...]] = (
    *(0, 1, -1, 2**31, 2**53, 2**63, 2**64 - 1, 1e308, float("nan"), float("inf")),
    *(None, True, b"", b"\xc1" * 40, "", [], {}, [[[[]]]]),
)
_TASK: Final = TaskId("a", "Count")
_Z: Final = Identity("z", "j")
_EPOCH: Final = Epoch(3, _Z)
_REGISTER: Final = Register(_EPOCH, 4, ((_Z,),), 0, Identity("a"))
_ASKED: Final = Solicit(_TASK, 1, "test.Count", "1", "client")
_BODIES: Final[Sequence[tuple[str, Any]]] = (
    *(
        (SYSCTRL, body)
        for body in (
            Describe(),
            Stop("Count"),
            Start("Count"),
            Configure("Count", {"a": 1}),
            Reschedule("Count", 5.0),
            Migrate("Count"),
            Adopt("Count"),
            SetFence("motors", "a/Count"),
            Shutdown(),
            Follow("log"),
            Reply(None, None, 1),
        )
    ),
    *(
        (NETWORK, body)
        for body in (
            _ASKED,
            Bid(_TASK, 1, 0.5, {"tasks": 1.0}),
            Refuse(_TASK, 1, Refusal("unable", "no")),
            Accept(_TASK, "test.Count", "client", _REGISTER, 5, 2.0, state=b"x" * 50),
            Piece(_TASK, (_EPOCH, 4), 0, 2, 100, b"\0" * 32, b"x" * 50),
            Accepted(_TASK, _EPOCH, _Z, 5, 4),
            Prepare(_TASK, "test.Count", _EPOCH, (_EPOCH, 4), ((_Z,),)),
            Promise(_TASK, _EPOCH, _Z, _REGISTER, b"x" * 50),
            WhoHas((_TASK,)),
            Known(_Z, (_TASK,), (Fact(_TASK, _REGISTER),)),
            BootRemembered("j", 3, "life"),
            Call(_TASK, "test.Count", "client", _EPOCH, ((_Z,),)),
            MayGuard(_TASK, "test.Count"),
            CanGuard(_TASK, _Z, "", True, False, 1.0),
            Letter("a/Count", "z/1.1", 1, 1, b"\x91\x00", "z"),
            Receipt("a/Count", "z/1.1", 1, 1),
            ForwardTo("a/Count", "b", 1),
            AskBegan("a/Count", ("z/1.1",)),
            StreamsBegan("a/Count", 1, {"z/1.1": 0}),
        )
    ),
    (CTRL, Load(0.5)),
    (SYSTEM, Battery(7.2, 0.5)),
    (LOG, Event("peer_up", {"peer": "z"})),
    (LOG, LogLine("info", "hello")),
    ("chat", Load(0.1)),
)


@dataclass
class Fuzzed:
    """The result.

    Attributes:
        frames: how many frames were sent.
        ended: how many links the agent ended.
        grown_mib: how much its memory grew.
        said: the lines of its log about defects.
    """

    frames: int
    ended: int
    grown_mib: float
    said: list[str]


def pools(source: random.Random) -> tuple[list[bytes], list[bytes]]:
    """Return frames that keep a link, and frames that end one; most have a wrong part."""
    keeping = [
        frame([encode_link_message(Gossip((AgentSeen(f"n{number}", f"tcp://10.0.0.{number}:9"),)))])
        for number in range(50)
    ]
    keeping += [
        frame([encode_link_message(it)]) for it in (Ping(1), Pong(2**40, 0.0), RosterNumber(0), RosterNumber(9))
    ]
    ending = [b"\0\0\0\x02\xc1\xc1", b"\xff\xff\xff\xff", b"\0\0\0\x01\x05"]
    while len(keeping) < POOL:
        channel, body = source.choice(_BODIES)
        packet = Packet(
            channel,
            type_name(body),
            source.choice(["z/network/TaskMigrator", "z/client/T", "z", *NAMES[:5]]) or "z",
            source.choice(["a", "a/network/TaskMigrator", "a/client", "a/kernel/Courier", "a/kernel/Registrar", ""]),
            0.0,
            source.randrange(1000),
            body,
        )
        messages: Any = msgpack.unpackb(message_of(packet), strict_map_key=False)
        for _ in range(source.choice([0, 0, 1, 1, 2, 5])):
            messages = changed(messages, source)
        with contextlib.suppress(ValueError, OverflowError, TypeError):
            made = frame([msgpack.packb(messages)])
            (keeping if is_kept(made) else ending).append(made)
    return keeping, ending


def is_kept(made: bytes) -> bool:
    """Return whether a frame breaks no rule of the protocol, even if its packets are useless."""
    try:
        return all(isinstance(it, PacketRun) and list(packets_of(it)) for it in messages_from_payload(made[4:]))
    except RemoteProtocolError:
        return False


def changed(value: Any, source: random.Random) -> Any:
    """Return a message with one part replaced."""
    if isinstance(value, list) and value and source.random() < 0.9:
        place = source.randrange(len(value))
        deed = source.random()
        if deed < 0.08:
            return value[:place] + value[place + 1 :]
        if deed < 0.16:
            return [*value[:place], value[place], *value[place:]]
        return [*value[:place], changed(value[place], source), *value[place + 1 :]]
    if isinstance(value, dict) and value and source.random() < 0.9:
        key = source.choice(list(value))
        return {**value, key: changed(value[key], source)}
    if isinstance(value, str) and source.random() < 0.7:
        return source.choice(NAMES)
    if isinstance(value, bytes) and value and source.random() < 0.7:
        at = source.randrange(len(value))
        return value[:at] + bytes([source.randrange(256)]) + value[at + 1 :]
    return source.choice(ODD)


class Fuzzer:
    """Sends frames to an agent over TLS, as the member `z` of its fleet.

    Args:
        folder: its keys.
        port: where the agent listens.
        source: random numbers for the frames.
    """

    def __init__(self, folder: Path, port: int, source: random.Random) -> None:
        self._port = port
        self._source = source
        self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        self._context.check_hostname = False
        self._context.load_verify_locations(folder / "fleet.pem")
        self._context.load_cert_chain(folder / "key.pem")
        self._keeping, self._ending = pools(source)

    @contextlib.contextmanager
    def _linked(self) -> Iterator[ssl.SSLSocket]:
        raw = socket.create_connection(("127.0.0.1", self._port), PATIENCE_S)
        with self._context.wrap_socket(raw) as link:
            link.sendall(raw_hello("z", fleet="test", journal="journal of z", boot=1))
            link.recv(65536)
            yield link

    def send(self, frames: int, ended: int) -> tuple[int, int]:
        """Send at least `frames` frames, until `ended` links have ended; return both numbers.

        Raises:
            ConnectionRefusedError: the agent has ended.
        """
        sent = links = 0
        while sent < frames or links < ended:
            rest = max(frames - sent, 1) / max(ended - links, 1)
            left = max(1, round(rest))
            try:
                with self._linked() as link:
                    link.setblocking(False)
                    while left > 0:
                        part = self._source.choices(self._keeping, k=min(BATCH, left))
                        self._give(link, b"".join(part))
                        sent += len(part)
                        left -= len(part)
                    self._give(link, self._source.choice(self._ending) + b"\0\0\0\x01\x05")
                    self._until_ended(link)
            except ConnectionRefusedError:
                raise
            except OSError:
                pass
            links += 1
        return sent, links

    def _give(self, link: ssl.SSLSocket, data: bytes) -> None:
        """Send, and read the answers: an agent whose answers are not read would stop reading."""
        view = memoryview(data)
        until_s = time.monotonic() + PATIENCE_S
        while view:
            with contextlib.suppress(ssl.SSLWantReadError, ssl.SSLWantWriteError):
                view = view[link.send(view[:65536]) :]
            with contextlib.suppress(ssl.SSLWantReadError, ssl.SSLWantWriteError):
                if not link.recv(65536):
                    raise ConnectionResetError
            if time.monotonic() > until_s:
                raise TimeoutError

    def _until_ended(self, link: ssl.SSLSocket) -> None:
        link.settimeout(PATIENCE_S)
        while link.recv(65536):
            pass


def fuzz(rig: Rig, frames: int, ended: int, seed: int) -> Fuzzed:
    """Send frames to a live agent; return the result.

    Args:
        rig: starts it.
        frames: how many frames.
        ended: how many links must end.
        seed: the seed of the frames.
    """
    agent = rig.ready("a", _AGENT, agent=f'state_dir = "{rig.directory}/state"')
    fuzzer = Fuzzer(rig.keys.of_agent("test", "z"), rig.port(agent), random.Random(seed))
    try:
        fuzzer.send(frames // 20, ended // 20)  # memory that the agent needs only once
        before = psutil.Process(agent.pid).memory_info().rss
        sent, links = fuzzer.send(frames, ended)
    except ConnectionRefusedError:
        return Fuzzed(0, 0, 0.0, ["it has ended:", *agent.so_far()[-20:]])
    grown = (psutil.Process(agent.pid).memory_info().rss - before) / 2**20
    assert rig.pancakes("task", "list", "a").returncode == 0, "the agent answers its own user"
    return Fuzzed(sent, links, grown, [line for line in agent.so_far() if _is_defect(line)])


_AGENT: Final = """
[device.motors]
driver = "null.motors"
[channel.chat]
"""


def _is_defect(line: str) -> bool:
    return "Traceback" in line or "failed: " in line or " critical " in line


def unsound(found: Fuzzed) -> list[str]:
    """Return a sentence for each fault."""
    wrong = [f"the agent said: {line}" for line in found.said]
    if found.grown_mib > MEMORY_MIB:
        wrong.append(f"its memory has grown by {found.grown_mib:.1f} MiB")
    return wrong
