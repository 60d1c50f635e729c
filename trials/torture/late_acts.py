"""Measure late acts: the owner of a guarded task is stopped for longer than its lease, and then continues.

Everything is judged from outside, by the clock that all processes of a machine share and that includes suspends: a
driver logs each command that it obeys, a peer each packet that it gets, the owner each permit that it gets and each
checkpoint that it begins to write. An act between the end of the stop and the next permit is late.
"""

from __future__ import annotations

import random
import signal
import time
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from torture.live import LiveFleet

NAMES = ("a", "b", "c")
LEASE_S = 2.0
PATIENCE_S = 30.0

SOURCE = '''
import os
import time
from dataclasses import dataclass

from pancakes.devices.driver import Actuator
from pancakes.devices import Twist
from pancakes.durable.record import Record
from pancakes.packet import packet_type
from pancakes.journal import FileJournal
from pancakes.kernel.permits import Permits
from pancakes.task import Task, every

DIRECTORY = "THE_DIRECTORY"


def book(name):
    out = os.open(os.path.join(DIRECTORY, name), os.O_CREAT | os.O_WRONLY | os.O_APPEND)
    return lambda n: os.write(out, f"{time.clock_gettime_ns(time.CLOCK_BOOTTIME)} {n}\\n".encode())


@packet_type("late.note")
@dataclass
class Note:
    """The number of the turn that sent a packet."""

    n: int


class Flood(Task):
    """Commands wheels and sends packets to a peer, as often as it can."""

    requires = ("motors",)

    @dataclass
    class State:
        n: int = 0

    @every(hz=500)
    def act(self, tick):
        self.state.n += 1
        for _ in range(10):
            self.publish("system", Note(self.state.n), to="b/client/Ear")
        if self.state.n % 10 == 0:
            for _ in range(10):
                self.publish("ctrl", Twist(0.1, float(self.state.n)))


class Ear(Task):
    """Logs the packets that arrive, in the thread that delivers them."""

    def on_start(self):
        write = book("packets")
        self.heard = lambda packet: write(packet.body.n)
        self._actor.kernel.stream.tap("system", self.heard, ("late.note",))

    def on_stop(self):
        self._actor.kernel.stream.untap("system", self.heard)


class Recorder(Actuator):
    """Wheels that log their commands, and are as slow as a serial line, so that commands have to wait."""

    type = "motors"

    def open(self):
        self.note = book("commands")

    def write(self, command, ttl_s, source):
        time.sleep(0.0015)
        self.note(int(command.omega_radps))

    def safe_stop(self):
        pass


if os.environ.get("PANCAKES_LATE_OWNER"):
    given, give = book("permits"), Permits.give
    written, write = book("checkpoints"), FileJournal.write

    def noted_give(self, fence, until):
        given(0)
        give(self, fence, until)

    newest = [0]

    def noted_write(self, batch):
        # A task that failed in the turn in which its permit ended is restarted, which is not a new checkpoint.
        numbers = [Record.decode(entry.data).register.no for entry in batch if entry.kind == "record"]
        if any(no != newest[0] for no in numbers):
            newest[0] = numbers[-1]
            written(newest[0])
        write(self, batch)

    Permits.give, FileJournal.write = noted_give, noted_write
'''
ENTRY_POINTS = """
[pancakes.tasks]
late.Flood = plugin_late:Flood
late.Ear = plugin_late:Ear

[pancakes.packets]
late = plugin_late

[pancakes.drivers]
late.recorder = plugin_late:Recorder
"""

Act = tuple[int, int]
"""A time in nanoseconds, and the number of a turn."""


@dataclass
class LateTally:
    """What happened.

    Attributes:
        stops: how often the owner was stopped.
        commands: how many commands were obeyed late after each stop.
        packets: how many packets came late.
        sends: the number of turns with late packets: the packets of one turn are sent with one system call.
        checkpoints: how many checkpoints were written late.
        acts: how many commands and packets there were, in all.
        without_s: for how long the owner had no permit after it went on, in seconds.
    """

    stops: int = 0
    commands: list[int] = field(default_factory=list)
    packets: list[int] = field(default_factory=list)
    sends: list[int] = field(default_factory=list)
    checkpoints: list[int] = field(default_factory=list)
    acts: int = 0
    without_s: list[float] = field(default_factory=list)

    def add(self, other: LateTally) -> None:
        """Add what happened to another fleet."""
        self.stops += other.stops
        self.commands += other.commands
        self.packets += other.packets
        self.sends += other.sends
        self.checkpoints += other.checkpoints
        self.acts += other.acts
        self.without_s += other.without_s

    @property
    def most(self) -> int:
        """The most acts of one kind that came late after one stop."""
        return max((*self.commands, *self.sends, *self.checkpoints), default=0)

    def told(self) -> str:
        """Return the outcome as a line."""
        without = f"{max(self.without_s):.3f} s without a permit at most" if self.without_s else "never went on"
        return (
            f"{self.stops} stops longer than the lease, {self.acts} acts; late: {sum(self.commands)} commands,"
            f" {sum(self.packets)} packets in {sum(self.sends)} sends, {sum(self.checkpoints)} checkpoints;"
            f" after one stop at most {self.most} of a kind; {without}"
        )


def late_between(acts: Sequence[Act], on_ns: int, permit_ns: int) -> Sequence[Act]:
    """Return the acts after a process continued and before it had a permit; `acts` is in the order of time."""
    return acts[
        bisect_right(acts, on_ns, key=lambda act: act[0]) : bisect_left(acts, permit_ns, key=lambda act: act[0])
    ]


class LateActs:
    """One fleet of an owner and two guardians.

    Args:
        directory: all files.
        seed: the seed of the moments; the rest depends on the machine.
        spoilt_by: Python that breaks the agents, see `LiveFleet`.
    """

    def __init__(self, directory: Path, seed: int, spoilt_by: str = "") -> None:
        self._random = random.Random(f"late/{seed}")
        self._directory = directory
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        guard = f'{{ copies = 3, lease_s = {LEASE_S}, checkpoint_s = 0.1, takeover = "ask" }}'
        flood = f'[task.Flood]\ntype = "late.Flood"\nguard = {guard}\n[device.motors]\ndriver = "late.recorder"\n'
        log = '[service.log]\nsettings = {level = "warning"}\n'
        rest = {"a": flood + log, "b": f'[task.Ear]\ntype = "late.Ear"\n{log}', "c": log}
        listen = {name: f"local://{directory}/{name}" for name in NAMES}
        commands = {"a": ["env", "PANCAKES_LATE_OWNER=1"]}
        self._fleet = LiveFleet(directory, NAMES, rest, listen, commands=commands, spoilt_by=spoilt_by)
        self._fleet.rig.install("late", ENTRY_POINTS, SOURCE.replace("THE_DIRECTORY", str(directory)))

    def run(self, stops: int) -> LateTally:
        """Stop the owner `stops` times, and judge."""
        fleet, spells = self._fleet, []
        try:
            for name in reversed(NAMES):
                fleet.start(name)
            self._wait_for_permit(0)
            time.sleep(3.0)  # the time to choose guardians
            for _ in range(stops):
                spells.append(self._stop())
                time.sleep(self._random.uniform(0.3, 1.3))
        finally:
            fleet.close()
        return self._judge(spells)

    def _stop(self) -> Act:
        """Stop the owner, let it continue, and wait for its permit; return the times of both."""
        process = self._fleet.running["a"].process
        process.send_signal(signal.SIGSTOP)
        time.sleep(self._random.uniform(1.05, 1.5) * LEASE_S)
        on_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        process.send_signal(signal.SIGCONT)
        return on_ns, self._wait_for_permit(on_ns)

    def _wait_for_permit(self, after_ns: int) -> int:
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            given = [at_ns for at_ns, _ in self._acts("permits") if at_ns > after_ns]
            if given:
                return given[0]
            time.sleep(0.02)
        raise TimeoutError("the owner was given no permit")

    def _judge(self, spells: Sequence[Act]) -> LateTally:
        commands, packets, checkpoints = (self._acts(name) for name in ("commands", "packets", "checkpoints"))
        tally = LateTally(len(spells), acts=len(commands) + len(packets))
        for on_ns, permit_ns in spells:
            late = late_between(packets, on_ns, permit_ns)
            tally.commands.append(len(late_between(commands, on_ns, permit_ns)))
            tally.packets.append(len(late))
            tally.sends.append(len({n for _, n in late}))
            tally.checkpoints.append(len(late_between(checkpoints, on_ns, permit_ns)))
            tally.without_s.append((permit_ns - on_ns) / 1e9)
        return tally

    def _acts(self, name: str) -> list[Act]:
        path = self._directory / name
        if not path.exists():
            return []
        lines = path.read_text().splitlines(keepends=True)
        acts = [tuple(map(int, line.split())) for line in lines if line.endswith("\n")]
        return sorted((at_ns, n) for at_ns, n in acts)


def run_late_acts(directory: Path, stops: int, fleets: int, seed: int = 1, spoilt_by: str = "") -> LateTally:
    """Run several fleets at once, and stop the owner of each; return the outcome of all."""
    made = [LateActs(directory / str(number), seed + number, spoilt_by) for number in range(fleets)]
    total = LateTally()
    with ThreadPoolExecutor(fleets) as pool:
        for tally in pool.map(lambda one: one.run(stops), made):
            total.add(tally)
    return total
