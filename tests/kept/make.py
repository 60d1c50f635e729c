"""Keeps state directories, a recording and keys of this version, on which later versions are tried.

    python tests/kept/make.py

writes tests/kept/data/VERSION-COMMIT. See the README beside this file.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from kept.tasks import Count, Drive, Receiver, Sender

from pancakes import __version__
from pancakes.control import Configure, Create, Guarding, Migrate, Remove, Reschedule, Start, Stop
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Standing
from pancakes.durable.snapshot import Snapshot
from pancakes.journal.file_journal import read_ahead
from pancakes.journal.journal import JournalEntry, unseal
from pancakes.packet import SYSCTRL
from pancakes.security.authority import Authority
from pancakes.security.roster import AccessRule
from pancakes.testing import AgentHandle, Fleet, threaded_agent

HERE = Path(__file__).resolve().parent
DATA = HERE / "data"
CLASSES: dict[str, type] = {"kept.Count": Count, "kept.Drive": Drive, "kept.Receiver": Receiver, "kept.Sender": Sender}
RECORDER = "log/Recorder"
FLEET = "kept"
WANTED_RECORDING = "recording.log%2FRecorder.rec"
LONG_AGO_NS = 1_767_225_600 * 10**9
"""The first of January 2026, when the keys were made: certificates of people have ended since then."""

SENSORS = """
[device.pose]
driver = "static.pose"
rate_hz = 5
settings = { x_m = 0.25, y_m = 0.5 }

[device.motors]
driver = "null.motors"
"""
FILES = {
    "a": f"""schema = 1

[agent]
name = "a"
fleet = "{FLEET}"
{SENSORS}
[task.Count]
type = "kept.Count"
rate_hz = 20
durability = "each"
settings = {{ step = 2, label = "from the file" }}

[task.Stopped]
type = "kept.Count"

[task.Guarded]
type = "kept.Count"
guard = {{ copies = 3, lease_s = 2.0, checkpoint_s = 0.5, guardians = ["b", "c"] }}

[task.Moved]
type = "kept.Count"

[task.Drive]
type = "kept.Drive"

[task.Receiver]
type = "kept.Receiver"
durability = "each"
""",
    "b": f"""schema = 1

[agent]
name = "b"
fleet = "{FLEET}"
{SENSORS}
[task.Sender]
type = "kept.Sender"
start = false
""",
    "c": f"""schema = 1

[agent]
name = "c"
fleet = "{FLEET}"
""",
}
ALONE = f"""schema = 1

[agent]
name = "alone"
fleet = "{FLEET}"

[task.Count]
type = "kept.Count"
durability = "each"

[task.Stopped]
type = "kept.Count"
"""


def make(into: Path) -> None:
    """Makes all that is kept of a version, in a folder that is not there yet."""
    # Elsewhere first: some of the files have the path in them that they were written to.
    with tempfile.TemporaryDirectory(prefix="pancakes-kept-") as directory:
        place = Path(directory) / "kept"
        place.mkdir()
        expected = {
            "fleet": keep_fleet(place / "fleet"),
            "agent": keep_agent(place / "agent"),
            "recording": keep_recording(place / "recording"),
        }
        keep_keys(place / "keys")
        (place / "expected.json").write_text(json.dumps(expected, indent=2, sort_keys=True) + "\n")
        shutil.copytree(place, into)


def saved_in(entry: JournalEntry) -> dict[str, Any]:
    """Returns the settings, the periods and the state of a task that its record has, as JSON can say them."""
    snapshot = Snapshot.decode(Record.decode(entry.data).snapshot)
    return plain({"settings": snapshot.settings, "periods_s": snapshot.periods_s, "state": snapshot.state})


def plain(value: Any) -> Any:
    """Returns a value as JSON can say it."""
    return json.loads(json.dumps(value, default=_of_json))


def _of_json(value: Any) -> Any:
    return {"bytes": value.hex()} if isinstance(value, bytes) else {"array": value.tolist(), "type": value.dtype.str}


@contextlib.contextmanager
def started(folder: Path, channels: tuple[str, ...] = ()) -> Iterator[Fleet]:
    """Starts the fleet of the configuration files in a folder in virtual time, on the disks that lie beside them.

    Without the recording that c was asked for: that would go on where it was written then.
    """
    with Fleet(seed=41, classes=CLASSES, channels=channels) as fleet:
        for file in sorted(folder.glob("*.toml")):
            disk = folder / file.stem
            found = {it.name: it.read_bytes() for it in disk.iterdir() if it.name != WANTED_RECORDING}
            fleet.disk(file.stem).update(found)
            fleet.start(file.stem, file.read_text())
        fleet.connect()
        yield fleet


# State directories -----------------------------------------------------------------------------------------------


def keep_fleet(folder: Path) -> dict[str, Any]:
    """Keeps the disks of three agents in virtual time, whose power fails while a task moves from b to c."""
    folder.mkdir()
    for name, text in FILES.items():
        (folder / f"{name}.toml").write_text(text)
        (folder / name).mkdir()
    with started(folder) as fleet:
        a, b, c = (fleet.agents[name] for name in "abc")
        fleet.run_for(5.0)
        _done(fleet, lambda: len(_guardians(a)) == 3)
        _asked(a, Create("Created", "kept.Count", settings={"label": "created"}, rate_hz=4.0))
        _asked(a, Create("Removed", "kept.Count"))
        _asked(a, Configure("Count", {"step": 3, "weights": {"near": 0.5}}), Reschedule("Count", 5.0))
        _asked(c, Start(RECORDER, {"path": str(folder.parent / "c.mcap")}))
        wanted_recording = fleet.disk("c")[WANTED_RECORDING]
        _asked(c, Stop(RECORDER))  # an open file would be left by the crash
        a.publish(SYSCTRL, Migrate("Moved", to="b"))
        _done(fleet, lambda: b.running() == ["Moved"])
        _asked(a, Stop("Stopped"), Remove("Removed"))
        _asked(b, Start("Sender"))
        fleet.run_for(1.0)
        fleet.faults.cut("a", off=("b",))
        fleet.run_for(1.0)
        b.publish(SYSCTRL, Migrate("Sender", to="c"))
        client: Any = b.component("client")
        place = client.places[TaskId("b", "Sender")]
        while place.record.standing is not Standing.YIELDED:
            assert fleet.dispatcher.step()
        for name in "abc":
            fleet.crash(name)
        for name in "abc":
            for file, data in fleet.disk(name).items():
                (folder / name / file).write_bytes(data)
    (folder / "c" / WANTED_RECORDING).write_bytes(wanted_recording)
    owners = {"Count": "a", "Created": "a", "Drive": "a", "Guarded": "a", "Receiver": "a", "Moved": "b", "Sender": "c"}
    files = {
        name: folder / agent / f"record.{'b' if name == 'Sender' else 'a'}%2F{name}.rec"
        for name, agent in owners.items()
    }
    return {name: {"agent": owners[name], **saved_in(unseal("", file.read_bytes()))} for name, file in files.items()}


def keep_agent(folder: Path) -> dict[str, Any]:
    """Keeps the state directory of an agent that runs on threads, with a journal on a true disk, and is killed."""
    folder.mkdir()
    (folder / "alone.toml").write_text(ALONE)
    code = f"from kept.make import run_until_killed; run_until_killed({str(folder / 'state')!r})"
    environment = {**os.environ, "PYTHONPATH": str(HERE.parent)}
    ended = subprocess.run([sys.executable, "-c", code], env=environment, timeout=60.0)
    assert ended.returncode == -signal.SIGKILL
    batches = read_ahead((folder / "state" / "journal.wal").read_bytes()).batches
    entries = {(entry.kind, entry.key): entry for batch in batches for entry in batch.entries}
    return {"Count": {"agent": "alone", **saved_in(entries["record", "alone/Count"])}}


def run_until_killed(state: str) -> None:
    """Runs an agent on threads on a state directory, and kills this process when its task has counted to 20."""
    with threaded_agent("alone", ALONE, classes=CLASSES, state_dir=Path(state)) as agent:
        _asked(agent, Configure("Count", {"label": "set", "step": 2}), Stop("Stopped"))
        agent.wait_until(lambda: agent.task("Count").state.n >= 20)
        os.kill(os.getpid(), signal.SIGKILL)


def _asked(agent: AgentHandle, *bodies: Any) -> None:
    for body in bodies:
        reply = agent.ask(body)
        assert reply.ok, reply.reason


def _done(fleet: Fleet, condition: Any) -> None:
    assert fleet.run_until(condition, 20.0)


def _guardians(agent: AgentHandle) -> list[Any]:
    rows = agent.ask(Guarding()).result
    return [guardian for row in rows for guardian in row["guardians"]]


# Recording -------------------------------------------------------------------------------------------------------


def keep_recording(folder: Path) -> dict[str, Any]:
    """Keeps what two agents say while a task that answers poses moves from one to the other."""
    folder.mkdir()
    for name in "ab":
        tasks = '[task.Drive]\ntype = "kept.Drive"\nsettings = { gain = 0.5 }\nstart = false\n' if name == "a" else ""
        text = f'schema = 1\n\n[agent]\nname = "{name}"\nfleet = "{FLEET}"\n{SENSORS}\n{tasks}'
        (folder / f"{name}.toml").write_text(text)
    with Fleet(seed=42, classes=CLASSES) as fleet:
        a, b = (fleet.start(name, (folder / f"{name}.toml").read_text()) for name in "ab")
        fleet.connect()
        for agent in (a, b):
            _asked(agent, Start(RECORDER, {"path": str(folder / "{agent}.mcap"), "viewer": False}))
        _asked(a, Start("Drive"))
        fleet.run_for(2.0)
        a.publish(SYSCTRL, Migrate("Drive", to="b"))
        _done(fleet, lambda: b.running() == ["Drive"])
        fleet.run_for(2.0)
        commands = b.task("Drive").state.commands
        for agent in (a, b):
            _asked(agent, Stop(RECORDER))
    return {"commands": commands}


# Keys ------------------------------------------------------------------------------------------------------------


def keep_keys(folder: Path) -> None:
    """Keeps the authority of a fleet, keys of two agents and an operator, and a roster that revokes a third agent."""
    with mock.patch("time.time_ns", lambda: LONG_AGO_NS):
        authority = Authority.founded(FLEET, folder / "authority")
        for name in ("a", "b", "lost"):
            authority.enrol_with_key("agent", name).write(folder / name)
        authority.enrol_with_key("operator", "alice").write(folder / "alice")
        authority.revoke("lost", "left in the field")
        authority.allow(AccessRule(("alice",), ("look", "change"), ("*",)))
    for name in ("a", "b"):
        shutil.copy(folder / "authority" / "roster.json", folder / name)


def main() -> None:
    """Keeps this version, under its number and its commit or the name that is given."""
    if len(sys.argv) > 2 or sys.argv[1:2] in (["-h"], ["--help"]):
        sys.exit("usage: python tests/kept/make.py [NAME]")
    commit = subprocess.run(
        ["git", "rev-parse", "--short=8", "HEAD"], cwd=HERE, capture_output=True, text=True, check=True
    )
    name = sys.argv[1] if sys.argv[1:] else f"{__version__.removesuffix('.0')}-{commit.stdout.strip()}"
    began_s = time.monotonic()
    make(DATA / name)
    size = sum(it.stat().st_size for it in (DATA / name).rglob("*") if it.is_file())
    print(f"{DATA / name}: {size / 1024:.0f} KiB in {time.monotonic() - began_s:.1f} s")


if __name__ == "__main__":
    main()
