"""What msgspec knows of types is built by one thread at a time; and a lack of memory ends no process."""

from __future__ import annotations

import subprocess
import sys

MEETING = """
import sys, threading, types
from dataclasses import dataclass

import msgspec

from pancakes import packet, settings

from pancakes.util import schema
from pancakes.recording import message_format
from pancakes.mesh import codec

SOURCE = '''
class Inner(msgspec.Struct, frozen=True):
    a: int
    b: str = ""
    c: float = 0.0
    d: "list[int]" = []

@dataclass(frozen=True)
class Plain:
    inner: Inner
    others: tuple[Inner, ...] = ()

class Outer(msgspec.Struct, frozen=True):
    x: int
    y: Inner
    z: "Inner | None" = None
    w: "list[Plain]" = []
'''

def meet(ways):
    failures = []
    barrier = threading.Barrier(len(ways))

    def one(way):
        barrier.wait()
        try:
            way()
        except BaseException as error:
            failures.append(repr(error))

    threads = [threading.Thread(target=one, args=(way,)) for way in ways]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures, failures


sys.setswitchinterval(1e-6)
for number in range(int(sys.argv[1])):
    made = types.ModuleType(f"made{number}")
    made.__dict__.update(msgspec=msgspec, dataclass=dataclass)
    sys.modules[made.__name__] = made
    exec(SOURCE, made.__dict__)
    kind = f"codecs test {number}"
    outer = packet.packet_type(kind)(made.Outer)
    body = outer(1, made.Inner(1), made.Inner(2), [made.Plain(made.Inner(3))])
    plain = packet.body_to_plain(body)
    it = packet.Packet("system", kind, "a/client/t", "b", 0.0, 1, body)
    unmet = packet.Packet("system", kind, "a/client/t", "b", 0.0, 1, plain)  # to encode the body looks at its class
    head = codec.head_of(it)
    run = codec.messages_from_payload(b"\\x91" + codec.run_of(head, [codec.RowEncoder(b"").encode(unmet)]))
    letter = [codec.encode_packet(unmet)]

    def received(run=run, body=body):
        packets, unfit = codec.packets_of(run[0])
        assert not unfit and packets[0].body == body, unfit

    def letters(letter=letter, body=body):
        (row,) = codec.rows_from_payload(b"\\x91" + letter[0])
        assert codec.packet_from_row(row).body == body

    def recorded(it=it, body=body, kind=kind):
        assert message_format.packet_from_data("system", kind, message_format.data_of(it)).body == body

    def given(made=made, plain=plain, body=body):
        assert settings.make_settings(made.Outer, plain) == body

    def checked(made=made):
        assert settings.check_settings(made.Plain, {"inner": {"a": 1}}) == []

    def sent(it=it, head=head):
        assert codec.RowEncoder(head).encode(it)

    def sketched(made=made):
        assert schema.schema_of(made.Outer)["properties"]["w"]

    meet([received, letters, recorded, given, checked, sent, sketched])
print("alive")
"""
"""The ways on which an agent meets a type for the first time, each in a thread of its own, with types that are new."""

SHORT = """
import contextlib, os, resource, sys
from pancakes.errors import PancakesError
from pancakes.packet import Packet, packet_type
from pancakes.journal import JournalEntry
from pancakes.journal.journal import seal
from pancakes.durable.record import TaskId
from pancakes.durable.snapshot import Snapshot
from pancakes.recording import message_format
from pancakes.durable.hosting import plain_of
from pancakes.supervision.messages import Carried
from pancakes.mesh.codec import encode_packet
from pancakes.mesh.codec import RowEncoder, head_of

LARGE = b"x" * 12_000_000
it = Packet("system", "unknown to all", "a/client/t", "b", 0.0, 1, {"data": LARGE})
listed = Packet("system", "unknown to all", "a/client/t", "b", 0.0, 1, [["some text"] * 60_000] * 30)
many = Packet("system", "unknown to all", "a/client/t", "b", 0.0, 1, {"many": ["text\\n"] * 1_500_000})
data = message_format.data_of(many)
TRIES = {
    "row": lambda: RowEncoder(head_of(it)).encode(it),
    "letter": lambda: encode_packet(listed),
    "seal": lambda: seal("journal", JournalEntry("task", "a/t", LARGE)),
    "snapshot": lambda: Snapshot(TaskId("a", "t"), "x.T", "1", "client", state={"data": LARGE}).encode(),
    "checkpoint": lambda: plain_of(Carried({}, {"data": LARGE}, {}, {})),
    "recorded": lambda: message_format.data_of(listed),
    "read": lambda: message_format.packet_from_data("system", "unknown to all", data),
}
MIB = 2**20
step, *names = sys.argv[1:]
for name in names or TRIES:
    with contextlib.suppress(PancakesError):
        TRIES[name]()  # so that what it imports is there
    with open("/proc/self/status") as file:
        (now,) = (int(line.split()[1]) * 1024 for line in file if line.startswith("VmSize"))
    ways = set()
    for left in range(0, 48, int(step)):
        child = os.fork()
        if child == 0:
            resource.setrlimit(resource.RLIMIT_AS, (now + 64 * MIB, now + 64 * MIB))
            held = []
            try:
                while True:
                    held.append(bytes(MIB))
            except MemoryError:
                del held[len(held) - left :]
            try:
                TRIES[name]()
            except (PancakesError, MemoryError):
                os._exit(3)
            os._exit(0)
        ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        assert ended in (0, 3), (name, left, ended)
        ways.add(ended)
    assert 3 in ways, f"memory was never short for {name}"
print("alive")
"""


def said_by(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Runs a program of its own: a crash takes no test with it."""
    command = [sys.executable, "-X", "faulthandler", "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=110)


def test_codecs_many_threads_meet_new_types() -> None:
    """Each round has four types; test_codecs_full.py has more."""
    ended = said_by(MEETING, "60")
    assert (ended.returncode, ended.stdout) == (0, "alive\n"), ended.stderr[-3000:]


def test_codecs_without_memory_raise_and_do_not_crash() -> None:
    ended = said_by(SHORT, "16")
    assert (ended.returncode, ended.stdout) == (0, "alive\n"), ended.stderr[-3000:]
