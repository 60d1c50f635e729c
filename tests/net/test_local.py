"""Connections within one machine: whose process is let in, and where the sockets lie."""

from __future__ import annotations

import grp
import os
import socket
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from net.conftest import LocalRig

from pancakes.errors import PancakesError
from pancakes.mesh import stream
from pancakes.mesh.address import Reach
from pancakes.mesh.event_loop import Loop
from pancakes.mesh.local import LocalTransport
from pancakes.mesh.transport import SocketTransport
from pancakes.util.clock import MonotonicClock
from pancakes.util.plugins import Plugins

STRANGER = 65534
CONNECTS = """
import os, socket, sys
os.setgroups([int(sys.argv[2])] if sys.argv[2] else [])
os.setgid(65534)
os.setuid(65534)
with socket.socket(socket.AF_UNIX) as link:
    try:
        link.connect(sys.argv[1])
        print("connected" if link.recv(1) else "closed")
    except OSError as error:
        print(error.strerror)
"""
"""Connects as another user, of one other group at most, and says what came of it."""

as_root = pytest.mark.skipif(os.getuid() != 0, reason="only root can be another user for a while")


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[LocalRig]:
    monkeypatch.setenv("PANCAKES_RUNTIME_DIR", str(tmp_path / "run"))
    made = LocalRig()
    yield made
    made.close()


def of_a_group(rig: LocalRig, group: str) -> SocketTransport:
    transport = SocketTransport(rig.clock, "a", Plugins(), {"local": {"group": group}})
    rig.transports.append(transport)
    return transport


def as_another_user(path: Path, group: int | None = None) -> str:
    above = [it for it in path.parents if it.is_relative_to("/tmp/") and it != Path("/tmp") and "run" not in it.parts]
    command = [sys.executable, "-c", CONNECTS, str(path), "" if group is None else str(group)]
    while True:
        for folder in above:
            folder.chmod(0o755)
        answer = subprocess.run(command, capture_output=True, text=True, check=True, cwd="/").stdout.strip()
        # Each pytest that starts, in a test for instance, closes the folder that all of them have to other users again.
        if all(mode(folder) == 0o755 for folder in above):
            return answer


def test_local_way_is_nearer_and_cheaper_than_tcp(rig):
    transport = rig.transport("a")
    local, tcp = transport.facts("local://a"), transport.facts("tcp://127.0.0.1:7401")
    assert (local.reach, tcp.reach) == (Reach.USER, Reach.MACHINE)
    assert local.cost < tcp.cost


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_the_sockets_are_for_their_user_alone(rig, tmp_path):
    rig.transport("a").listen("local://field/a", rig.ear)
    local = tmp_path / "run" / "local"
    assert {path: mode(path) for path in (local.parent, local, local / "field")} == dict.fromkeys(
        (local.parent, local, local / "field"), 0o700
    )
    assert mode(local / "field" / "a.sock") == 0o600


def test_a_directory_in_which_others_may_write_is_refused(rig, tmp_path):
    (tmp_path / "run" / "local").mkdir(parents=True)
    (tmp_path / "run").chmod(0o700)
    (tmp_path / "run" / "local").chmod(0o770)
    with pytest.raises(PancakesError, match=r"cannot listen at local://a: .*local is open to other users \(mode 770"):
        rig.transport("a").listen("local://a", rig.ear)
    ear = rig.ear()
    rig.transport("b").dial("local://a", ear)
    rig.until(lambda: ear.closed_for)
    assert "is open to other users" in ear.closed_for[0]


def test_a_closed_socket_is_taken_away_and_that_of_a_dead_agent_is_taken_over(rig, tmp_path):
    first = rig.transport("a")
    first.listen("local://a", rig.ear)
    first.listen("local://field/a", rig.ear)
    local = tmp_path / "run" / "local"
    assert [it.name for it in (local / "field").iterdir()] == ["a.sock"]
    first.close()
    assert list(local.iterdir()) == []
    path = local / "a.sock"

    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
        dead.listen()
    here, there = rig.ear(), rig.ear()
    rig.transport("b").listen("local://a", lambda: there)
    rig.transport("c").dial("local://a", here)
    rig.until(lambda: here.connection and there.connection)


def test_one_that_ends_takes_no_socket_of_another_away(rig, tmp_path):
    first = rig.transport("a")
    first.listen("local://a", rig.ear)
    (tmp_path / "run" / "local" / "a.sock").unlink()
    there = rig.ear()
    rig.transport("b").listen("local://a", lambda: there)
    first.close()
    here = rig.ear()
    rig.transport("c").dial("local://a", here)
    rig.until(lambda: here.connection and there.connection)


def test_an_agent_is_found_again_after_the_directory_of_a_persons_session_has_gone(rig, tmp_path, monkeypatch):
    monkeypatch.setattr(stream, "LOOK_S", 0.01)
    monkeypatch.delenv("PANCAKES_RUNTIME_DIR")
    session = tmp_path / "session"
    session.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(session))
    before, after = rig.ear(), rig.ear()
    ears = [before, after]
    a, b = rig.transport("a"), rig.transport("b")
    a.listen("local://field/a", lambda: ears.pop(0))
    b.dial("local://field/a", first := rig.ear())
    rig.until(lambda: before.connection and first.connection)

    session.rename(tmp_path / "ended")
    session.touch()
    failed = rig.ear()
    b.dial("local://field/a", failed)
    rig.until(lambda: failed.closed_for)
    session.unlink()
    session.mkdir(mode=0o700)
    dials = [failed]

    def connected() -> bool:
        if dials[-1].closed_for:
            dials.append(rig.ear())
            b.dial("local://field/a", dials[-1])
        return bool(dials[-1].connection and after.connection)

    rig.until(connected)
    assert not first.closed_for, "a connection that stands goes on"
    path = session / "pancakes" / "local" / "field" / "a.sock"
    assert path.is_socket()
    a.close()
    assert not path.exists()


def test_what_is_no_socket_is_left_alone(rig, tmp_path):
    (tmp_path / "run" / "local").mkdir(parents=True, mode=0o700)
    (tmp_path / "run").chmod(0o700)
    (tmp_path / "run" / "local").chmod(0o700)
    (tmp_path / "run" / "local" / "a.sock").write_text("notes")
    with pytest.raises(PancakesError, match="cannot listen at local://a: .*a.sock is no socket"):
        rig.transport("a").listen("local://a", rig.ear)
    assert (tmp_path / "run" / "local" / "a.sock").read_text() == "notes"


def test_a_path_that_is_too_long_for_a_socket_will_do(tmp_path, monkeypatch):
    deep = tmp_path / ("d" * 90) / ("e" * 90)
    deep.mkdir(parents=True)
    monkeypatch.setenv("PANCAKES_RUNTIME_DIR", str(deep / "run"))
    rig = LocalRig()
    here, there = rig.ear(), rig.ear()
    rig.transport("a").listen("local://" + "n" * 64, lambda: there)
    rig.transport("b").dial("local://" + "n" * 64, here)
    rig.until(lambda: here.connection and there.connection)
    assert here.connection is not None
    here.connection.send(b"hello")
    rig.until(lambda: there.data == b"hello")
    rig.close()
    assert not list((deep / "run" / "local").iterdir())


def test_a_path_may_be_named_as_it_is(rig, tmp_path):
    there = rig.ear()
    address = f"local://{tmp_path}/robot1"
    assert rig.transport("a").listen(address, lambda: there) == address
    here = rig.ear()
    rig.transport("b").dial(address, here)
    rig.until(lambda: here.connection and there.connection)
    assert there.connection.remote == f"local://process-{os.getpid()}"


def test_an_agent_of_the_default_fleet_is_found_with_and_without_its_fleet(rig):
    there = rig.ear()
    rig.transport("a").listen("local://a", lambda: there)
    here = rig.ear()
    rig.transport("b").dial("local://default/a", here)
    rig.until(lambda: here.connection and there.connection)


@pytest.mark.parametrize("address", ["local://", "local://a:7401", "local://a/b/c", "local://../a", "local://a b"])
def test_what_names_no_socket_is_said(rig, address):
    with pytest.raises(PancakesError, match="is no address: write it as local://NAME"):
        rig.transport("a").listen(address, rig.ear)


def test_an_unknown_group_is_said(rig):
    with pytest.raises(PancakesError, match="cannot listen at local://a: the group 'pancakers' of"):
        of_a_group(rig, "pancakers").listen("local://a", rig.ear)


def test_a_group_is_let_into_directory_and_socket(rig, tmp_path):
    group = grp.getgrgid(os.getgid()).gr_name
    of_a_group(rig, group).listen("local://field/a", rig.ear)
    local = tmp_path / "run" / "local"
    assert [mode(path) for path in (local.parent, local, local / "field")] == [0o750] * 3
    assert mode(local / "field" / "a.sock") == 0o660
    assert (local / "field" / "a.sock").stat().st_gid == os.getgid()


@as_root
def test_another_user_finds_no_way_in_and_is_refused_where_one_is_open(rig, tmp_path):
    ear = rig.ear()
    rig.transport("a").listen("local://a", lambda: ear)
    path = tmp_path / "run" / "local" / "a.sock"
    assert as_another_user(path) == "Permission denied"

    for folder in (tmp_path / "run", path.parent):
        folder.chmod(0o755)
    path.chmod(0o666)
    assert as_another_user(path) == "closed"
    rig.until(lambda: ear.closed_for)
    assert ear.connection is None
    assert ear.closed_for[0].startswith("at its other end is the process ")
    assert ear.closed_for[0].endswith(f"of another user (uid {STRANGER})")


@as_root
def test_the_log_of_an_agent_names_who_was_refused(rig, tmp_path):
    a = rig.agent("a", listen="local://a")
    for folder in (tmp_path / "run", tmp_path / "run" / "local"):
        folder.chmod(0o755)
    path = tmp_path / "run" / "local" / "a.sock"
    path.chmod(0o666)
    assert [as_another_user(path), as_another_user(path)] == ["closed", "closed"]
    rig.until(lambda: a.log("warning"))
    (line,) = a.log("warning").splitlines()
    assert line.startswith("no link over a connection from this machine: at its other end is the process ")
    assert line.endswith(f"of another user (uid {STRANGER})")


@as_root
def test_a_member_of_the_group_is_let_in_and_no_other(rig, tmp_path):
    group = grp.getgrnam("daemon")

    def greet():
        ear = rig.ear()
        ear.opened = lambda connection: connection.send(b"!")
        return ear

    of_a_group(rig, "daemon").listen("local://a", greet)
    path = tmp_path / "run" / "local" / "a.sock"
    assert as_another_user(path, group.gr_gid) == "connected"
    assert as_another_user(path) == "Permission denied"
    for folder in (tmp_path / "run", path.parent):
        folder.chmod(0o755)
    path.chmod(0o666)
    assert as_another_user(path) == "closed", "also where the file system lets it in"


def test_where_the_system_does_not_say_whose_process_comes_it_is_not_let_in():
    loop = Loop(MonotonicClock(), "net-test")
    with socket.socket(socket.AF_UNIX) as gone:
        pass
    reason = LocalTransport(loop, LocalTransport.Settings()).prepare(gone, "")
    loop.stop(lambda: None)
    assert reason == "the system does not say whose process is at its other end: Bad file descriptor"


@as_root
def test_who_listens_in_the_place_of_an_agent_is_not_believed(rig, tmp_path):
    """Somebody else's process holds a socket in a directory of ours, however it came there."""
    local = tmp_path / "run" / "local"
    rig.transport("a").listen("local://a", rig.ear)
    listens = (
        "import os, socket, sys, time\nos.chdir(sys.argv[1])\ns = socket.socket(socket.AF_UNIX)\n"
        "s.bind('b.sock')\nos.chmod('b.sock', 0o666)\nos.setuid(65534)\ns.listen()\nprint('ready', flush=True)\n"
        "time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", listens, str(local)], stdout=subprocess.PIPE, text=True) as squatter:
        assert squatter.stdout is not None and squatter.stdout.readline() == "ready\n"
        ear = rig.ear()
        rig.transport("c").dial("local://b", ear)
        rig.until(lambda: ear.closed_for)
        squatter.kill()
    assert ear.connection is None and f"of another user (uid {STRANGER})" in ear.closed_for[0]
