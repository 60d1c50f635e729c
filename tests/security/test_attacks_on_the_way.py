"""A machine in between two agents with keys: what it records, repeats and changes gets it nothing."""

from __future__ import annotations

import os
import socket
import stat
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from net.conftest import Agent, TlsRig

from pancakes.errors import PancakesError
from pancakes.security.key_store import write_private
from pancakes.security.keys import Keys

PATIENCE_S = 20.0


class Between:
    """Pass on what two agents say to each other, and keeps what the one that dials says.

    Args:
        address: where the other one listens.
        change: what becomes of each part that the one that dials says.
    """

    def __init__(self, address: str, change: Callable[[bytes], bytes] = lambda data: data) -> None:
        self._to = int(address.rpartition(":")[2])
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._links: list[socket.socket] = []
        self.change = change
        self.heard: list[bytes] = []
        self.address = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        try:
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(("127.0.0.1", self._to), PATIENCE_S)
                self._links += [near, far]
                self.heard.append(b"")
                number = len(self.heard) - 1
                threading.Thread(target=self._pass, args=(near, far, number), daemon=True).start()
                threading.Thread(target=self._pass, args=(far, near, -1), daemon=True).start()
        except OSError:
            return  # it was closed

    def _pass(self, source: socket.socket, sink: socket.socket, number: int) -> None:
        try:
            while data := source.recv(65536):
                if number >= 0:
                    self.heard[number] += data
                    data = self.change(data)
                sink.sendall(data)
        except OSError:
            pass
        for link in (source, sink):
            try:
                link.shutdown(socket.SHUT_RDWR)
            except OSError:
                continue

    def close(self) -> None:
        for link in (self._listener, *self._links):
            link.close()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[TlsRig]:
    made = TlsRig(tmp_path)
    yield made
    made.close()


@pytest.fixture
def linked(rig: TlsRig) -> Iterator[tuple[Agent, Agent, Between]]:
    """An agent, one that has dialled it, and what is in between."""
    a = rig.agent("a")
    between = Between(a.address)
    b = rig.agent("b", [between.address], listen="")
    rig.until(lambda: a.knows("b") and b.knows("a"))
    yield a, b, between
    between.close()


def test_what_was_said_once_opens_nothing_when_it_is_said_again(rig, linked):
    a, _, between = linked
    recorded = between.heard[0]
    assert len(recorded) > 500
    before = len(a.lines)
    with socket.create_connection(("127.0.0.1", int(a.address.rpartition(":")[2])), PATIENCE_S) as link:
        link.sendall(recorded)
        while link.recv(65536):
            pass
    rig.until(lambda: any("no link over a connection" in text for _, text in a.lines[before:]))
    assert a.ups == ["b"]


def test_one_changed_bit_ends_the_link_with_a_reason(rig, linked):
    a, b, between = linked

    def flipped(data: bytes) -> bytes:
        # In the first of the records that came together, behind its head: the others are behind it.
        return data[:5] + bytes([data[5] ^ 1]) + data[6:]

    between.change = flipped
    b.say("a", "hello")
    rig.until(lambda: a.downs)
    assert "what came was changed on its way" in a.downs[0][1]
    assert a.packets == []


def test_nothing_that_is_said_can_be_read_on_the_way(rig, linked):
    a, b, between = linked
    b.say("a", "the code of the door is 4711")
    rig.until(lambda: a.packets)
    assert b"4711" not in between.heard[0] and b"journal of b" not in between.heard[0]


@pytest.mark.skipif(os.getuid() != 0, reason="only root gives files away")
def test_a_key_of_another_user_is_refused(rig):
    folder = rig.enrol("a")
    os.chown(folder / "key.pem", 1234, -1)
    with pytest.raises(PancakesError, match=r"the key .*key\.pem belongs to another user \(uid 1234\)"):
        Keys(folder)


@pytest.mark.skipif(os.getuid() != 0, reason="only root gives files away")
def test_a_key_in_a_folder_of_another_user_is_refused(rig):
    folder = rig.enrol("a")
    os.chown(folder, 1234, -1)
    with pytest.raises(PancakesError, match="others can put files into the key folder"):
        Keys(folder)


def test_a_key_that_is_a_link_to_another_file_is_refused(rig):
    folder, other = rig.enrol("a"), rig.enrol("b")
    (folder / "key.pem").unlink()
    (folder / "key.pem").symlink_to(other / "key.pem")
    with pytest.raises(PancakesError, match=r"the key .*key\.pem is not a file"):
        Keys(folder)


@pytest.mark.parametrize("file", ["key.pem", "fleet.pem", "roster.json"])
def test_a_pipe_among_the_keys_keeps_nobody_waiting(rig, file):
    folder = rig.enrol("a")
    (folder / file).unlink()
    os.mkfifo(folder / file, 0o600)
    with pytest.raises(PancakesError, match=rf"{file} (is not a file|cannot be used: it is a pipe, not a file)"):
        Keys(folder)


def test_a_new_key_of_another_agent_is_not_taken_and_the_old_one_stays(rig):
    folder = rig.enrol("a")
    keys = Keys(folder)
    own = keys.own
    rig.authority.enrol_with_key("agent", "b").write(folder)
    with pytest.raises(PancakesError, match=r"the new key in .* is of b \(agent\) .*: the old one, of a, stays in use"):
        keys.reload()
    assert keys.own == own and not keys.reload()
    rig.authority.enrol_with_key("agent", "a").write(folder)
    assert keys.reload() and keys.own.name == "a" and keys.own != own


def test_no_file_is_written_through_a_link(tmp_path):
    target = tmp_path / "target"
    target.write_text("theirs")
    (tmp_path / f".key.pem.{os.getpid()}").symlink_to(target)
    with pytest.raises(OSError, match="symbolic links"):
        write_private(tmp_path / "key.pem", b"ours")
    assert target.read_text() == "theirs"


def test_what_is_private_is_so_from_its_first_moment(tmp_path, monkeypatch):
    """One that opens it before it is made private could read what is written later."""
    before, fchmod = [], os.fchmod

    def make_private(handle, mode):
        before.append(stat.S_IMODE(os.fstat(handle).st_mode))
        fchmod(handle, mode)

    monkeypatch.setattr(os, "fchmod", make_private)
    usual = os.umask(0)
    try:
        write_private(tmp_path / "key.pem", b"ours")
    finally:
        os.umask(usual)
    assert before == [0o600]


def test_what_is_private_is_so_whatever_was_there_before(tmp_path):
    before = tmp_path / f".key.pem.{os.getpid()}"
    before.write_text("left by one that was killed")
    before.chmod(0o644)
    write_private(tmp_path / "key.pem", b"ours")
    write_private(tmp_path / "other.pem", b"ours")
    assert [(tmp_path / it).stat().st_mode & 0o777 for it in ("key.pem", "other.pem")] == [0o600, 0o600]
