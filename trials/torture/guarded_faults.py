"""Strike real agents that guard a task with all kinds of faults, half of them during a migration or take-over.

The oracle is outside of the agents. The task counts in a file, and its actuators log each command, both with the
epoch, which must not decrease from line to line. An agent that is never struck sends the task numbered packets, and
each packet that the task acknowledged must have its effect exactly once.
"""

from __future__ import annotations

import json
import math
import random
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

from torture.deck import Deck
from torture.live import LiveFleet
from torture.proxy import Proxy
from torture.strokes import DISKS, FOR_GOOD, KILLS, KINDS, LOSSES, Stroke, Strokes
from torture.takeover_tally import Heard, TakeoverTally, Trace, Traces
from torture.waits import Waits

from pancakes.client import Client, Target
from pancakes.control import Guarding, Migrate
from pancakes.errors import PancakesError

NAMES: Final = ("a", "b", "c", "d")
TELLER: Final = "teller"
"""The agent that is never struck, and sends packets to the task."""
LEASE_S: Final = 2.0
GOES_ON_WITHIN_S: Final = 90.0
"""How long the task may stay paused after all faults are over; on a busy machine, processes start slowly."""
STARTS_WITHIN_S: Final = 300.0
"""The same for the first start of all agents of all fleets at once."""
MOST_STANDSTILLS: Final = 3
"""After this many standstills of the task, no more faults are made."""
REPLACED: Final = "import pancakes.durable.leases as leases\nleases.REPLACED_S = 12.0\n"
"""How soon a guardian with a lost disk is replaced: sooner than the usual minute, so that more disks can be lost."""


class Standstill(Exception):
    """No agent acts."""


class GuardedFleet:
    """One fleet of four agents with one task, guarded by three, and one that sends it packets.

    Args:
        directory: the folder for all files.
        seed: the seed of the faults; their timing depends on the machine.
        deck: deals out the kinds.
        waits: all waits of this fleet.
        spoilt_by: Python that breaks the agents, see `LiveFleet`.
        calm: whether faults come one at a time, and never during a migration.
    """

    def __init__(
        self, directory: Path, seed: int, deck: Deck, waits: Waits, spoilt_by: str = "", calm: bool = False
    ) -> None:
        self._random = random.Random(f"guarded/{seed}")
        self._deck, self._waits, self._calm = deck, waits, calm
        directory.mkdir(mode=0o700, parents=True)
        self._counts = Traces(directory / "One.count")
        self._commands = Traces(directory / "commands")
        self._heard = Heard(directory / "One.heard")
        self._told = directory / "One.told"
        common = '[service.log]\nsettings = {level = "warning"}\n'
        self._rest = (
            f'{common}[device.motors]\ndriver = "torture.tracer"\nsettings = {{file = "{directory}/commands"}}\n'
        )
        task = (
            f'[task.One]\ntype = "torture.Sentry"\nguard = {{ copies = 3, lease_s = {LEASE_S}, checkpoint_s = 0.5 }}\n'
        )
        task += f'durability = "each"\nsettings = {{directory = "{directory}"}}\n'
        tells = f'[task.Teller]\ntype = "torture.Teller"\nsettings = {{directory = "{directory}", to = ["a/One"]}}\n'
        rest = {**dict.fromkeys(NAMES, self._rest), "a": self._rest + task, TELLER: common + tells}
        names = (*NAMES, TELLER)
        listen = {name: f"local://{directory}/{name}" for name in names}
        self._proxies: dict[tuple[str, str], Proxy] = {}
        peers: dict[str, list[str]] = {name: [] for name in names}
        for number, dialled in enumerate(names):
            for dialler in names[:number]:
                proxy = self._proxies[dialler, dialled] = Proxy(listen[dialled])
                peers[dialler].append(proxy.address)
        self._fleet = LiveFleet(
            directory, names, rest, listen, peers, roles={TELLER: "environment"}, spoilt_by=REPLACED + spoilt_by
        )
        self._started_s: dict[str, float] = {}
        self._strokes = Strokes(self._fleet, self._proxies, LEASE_S, self._random, self._note_start)
        self._away: Stroke | None = None
        self._last = "a"
        self._acts = 0
        self._unread: list[Trace] = []  # judged commands that do not belong to a case yet

    def run(self, done: Callable[[TakeoverTally], None]) -> None:
        """Strike the fleet until no more faults are dealt out, or the task stays paused.

        Args:
            done: is told what happened in each case: one fault, or two, the second while the first is dealt with.

        Raises:
            InterruptedError: its waits were broken off.
        """
        try:
            tally = TakeoverTally()
            for name in self._fleet.names:
                self._fleet.start(name)
            try:
                self._wait_for_acts("the start", tally, STARTS_WITHIN_S)
                # After the loss of its own disk, this agent would create the task again.
                self._fleet.configure("a", self._rest)
                self._waits.until(self._comes_whole, GOES_ON_WITHIN_S)
                done(tally)
                while (case := self._case()) is not None:
                    done(case)
                tally = TakeoverTally()
                self._end(tally)
            except Standstill as standstill:
                tally = standstill.args[1]
                tally.standstills.append(standstill.args[0])
            done(tally)
        finally:
            self._strokes.close()
            self._fleet.close()
            for proxy in self._proxies.values():
                proxy.close()

    # Cases -----------------------------------------------------------------------------------------------------

    def _case(self) -> TakeoverTally | None:
        """Make one fault, or two; return the tally of this case; None: no more faults are dealt out."""
        draw, tally = self._random, TakeoverTally()
        if self._calm:
            if self._away is not None:
                self._come_back()
            self._waits.until(self._comes_whole, GOES_ON_WITHIN_S)
        kind = self._deal()
        if not kind and self._deck.left:  # other kinds are excluded
            if self._away is not None:
                self._come_back()
            self._waits.until(self._comes_whole, GOES_ON_WITHIN_S)
            kind = self._deal()
        if not kind:
            return None
        alone = self._away is None
        during = "" if self._calm else draw.choice(["", "hand-off", "take-over", "take-over"])
        second = self._deck.deal(DISKS) if during == "take-over" else ""
        if second and (kind not in LOSSES or (second == "full disk" and kind not in DISKS)):
            kind, second = second, kind
        owner = self._last
        if second and kind == "full disk":
            hit = draw.choice([name for name in self._up() if name != owner])
        elif second:
            hit = owner
        else:
            hit = self._target(kind, owner)
        tally.faults[kind] += 1
        if kind == "kill, restored disk" and (draw.random() < 0.5 or not self._strokes.is_backed_up(hit)):
            self._strokes.back_up(hit)
            self._waits.let(draw.uniform(0.5, 2.0))
        if during == "hand-off" or (second and kind not in (*LOSSES, "full disk")):
            during = "hand-off"
            self._move(owner)
            self._waits.let(draw.uniform(0.0, 0.05))
        struck_ns = time.monotonic_ns()
        strokes = [(time.monotonic(), self._strike(kind, hit))]
        if second:
            self._waits.let(draw.uniform(0.02, 1.2 * LEASE_S))
            # If the first fault filled a disk, the second one causes a take-over.
            target = owner if kind == "full disk" else self._target(second, self._last_now(tally), hit)
            tally.faults[second] += 1
            strokes.append((time.monotonic(), self._strike(second, target)))
        tally.meanwhile += len(strokes) if during == "hand-off" or kind == "full disk" else len(strokes) - 1
        if self._away is not None and draw.random() < 0.5:
            self._come_back()
        self._heal(strokes)
        story = f"{kind} of {hit}, {second or 'nothing else'}, where {owner} had it"
        self._wait_for_acts(story, tally)
        self._waits.let(draw.uniform(0.5, 1.5))
        commands = self._read(tally)
        tally.wrong = [f"{it} (after {story}, {during or 'at rest'})" for it in tally.wrong]
        if not second and not during and alone and hit == owner:
            self._measure(kind, hit, struck_ns, commands, tally)
        return tally

    def _deal(self) -> str:
        """Return the next kind of fault; empty: none may come now."""
        whole = self._away is None and self._is_whole()
        return self._deck.deal(() if whole else FOR_GOOD)

    def _strike(self, kind: str, hit: str) -> Stroke:
        return self._strokes.strike(kind, hit, [name for name in NAMES if name != hit])

    def _target(self, kind: str, owner: str, spared: str = "") -> str:
        """Draw the agent to strike: mostly the owner of the task, but another one for a full disk."""
        up = [name for name in self._up() if name != spared]
        others = [name for name in up if name != owner]
        if kind == "full disk" or owner not in up or (not self._calm and self._random.random() < 0.3):
            return self._random.choice(others)
        return owner

    def _up(self) -> list[str]:
        return [name for name in NAMES if name in self._fleet.running]

    def _heal(self, strokes: Sequence[tuple[float, Stroke]]) -> None:
        for began_s, stroke in sorted(strokes, key=lambda one: one[0] + one[1].for_s):
            if stroke.for_s == math.inf:
                if self._away is not None:
                    self._come_back()
                self._away = stroke
                continue
            self._waits.let(max(0.0, began_s + stroke.for_s - time.monotonic()))
            stroke.heal()
        if len(strokes) == 2 and self._away is not None:
            self._come_back()  # together with another lost disk or starting agent, this fault could be one too many

    def _come_back(self) -> None:
        assert self._away is not None
        away, self._away = self._away, None
        away.heal()

    def _measure(self, kind: str, hit: str, struck_ns: int, commands: Sequence[Trace], tally: TakeoverTally) -> None:
        """Record the time from the loss of the owner to the next command."""
        after = [trace for trace in commands if trace.at_ns > struck_ns]
        other = next((trace for trace in after if trace.epoch[1] != hit), None)
        # An owner that is being killed may still command.
        started_ns = self._started_s.get(hit, 0.0) * 1e9
        own = next((trace for trace in after if trace.epoch[1] == hit and trace.at_ns > started_ns > struck_ns), None)
        if kind in KILLS and own is not None and (other is None or own.at_ns < other.at_ns):
            tally.returned_s.append((own.at_ns - started_ns) / 1e9)
        elif other is not None and kind in LOSSES:
            gaps_s = tally.killed_s if kind in KILLS else tally.ended_s if kind == "goodbye" else tally.stood_s
            gaps_s.append((other.at_ns - struck_ns) / 1e9)

    # Looking ---------------------------------------------------------------------------------------------------

    def _read(self, tally: TakeoverTally) -> list[Trace]:
        commands = [*self._unread, *self._commands.read(tally)]
        self._unread = []
        acts = self._counts.read(tally)
        self._acts += len(acts)
        if acts:
            self._last = acts[-1].epoch[1]
        self._heard.read(tally)
        return commands

    def _last_now(self, tally: TakeoverTally) -> str:
        """Return the agent that acted last."""
        self._unread = self._read(tally)
        return self._last

    def _wait_for_acts(self, after: str, tally: TakeoverTally, within_s: float = GOES_ON_WITHIN_S) -> None:
        """Wait until the task acts.

        Raises:
            Standstill: it does not.
        """
        self._unread = self._read(tally)
        since = self._acts

        def acts(for_s: float) -> bool:
            time.sleep(for_s)
            self._unread = self._read(tally)
            return self._acts > since

        if not self._waits.until(acts, within_s):
            raise Standstill(f"no agent acts after {after}; {self._said()}", tally)

    def _said(self) -> str:
        """Return what the guardians report of the task, and the last lines of the agents' logs."""
        known = [f"{row}" for row in self._guarding()]
        said = [f"{name}: {line}" for name, one in self._fleet.running.items() for line in one.so_far()[-6:]]
        return "\n".join([*known, *said])

    def _guarding(self) -> list[dict[str, Any]]:
        """Return the reports of the running agents on the task that they guard."""
        rows: list[dict[str, Any]] = []
        names = (*self._up(), TELLER)
        with Client(Target(tuple(self._fleet.addresses[name] for name in names), "torture"), 2.0) as client:
            for name in names:
                try:
                    rows += client.request(name, Guarding()).result
                except PancakesError:
                    continue
        return rows

    def _comes_whole(self, within_s: float) -> bool:
        time.sleep(within_s)
        return self._is_whole()

    def _is_whole(self) -> bool:
        """Return whether the task has three guardians with a lease, so that one may lose its disk."""
        rows = self._guarding()
        owner = next((row for row in rows if "guardians" in row and row["lease"] and row["permit_s"]), None)
        if owner is None:
            return False
        held = {row["agent"] for row in rows if row["lease"] and row["epoch"] == owner["epoch"]}
        return len(owner["guardians"]) == 3 and set(owner["guardians"]) <= held

    def _move(self, owner: str) -> None:
        with Client(Target(tuple(self._fleet.addresses[name] for name in NAMES), "torture"), 0.2) as client:
            try:
                client.request(owner, Migrate("client/One"))
            except PancakesError:  # the answer is late, or the task has just migrated
                pass

    def _note_start(self, name: str) -> None:
        self._started_s[name] = time.monotonic()

    def _end(self, tally: TakeoverTally) -> None:
        """Wait until the task has handled all packets that were sent to it."""
        if self._away is not None:
            self._come_back()
        told = int(self._told.read_text() or 0)

        def heard(within_s: float) -> bool:
            time.sleep(within_s)
            self._read(tally)
            return self._heard.newest >= told

        if not self._waits.until(heard, GOES_ON_WITHIN_S):
            tally.wrong.append(f"packet {told} was not heard in {GOES_ON_WITHIN_S:g} s, only {self._heard.newest}")


class Takeovers:
    """Run several fleets at once, and save the tally, so that an interrupted run can continue.

    Args:
        directory: the folder with the file `done`, which has the tally; if it exists, the run continues from there.
        seed: the seed of the faults.
        spoilt_by: Python that breaks the agents, see `LiveFleet`.
        calm: whether faults come one at a time.
        kinds: the kinds of faults.
        told: called with the tally after each case.

    Attributes:
        tally: all cases so far.
    """

    def __init__(
        self,
        directory: Path,
        seed: int = 1,
        spoilt_by: str = "",
        calm: bool = False,
        kinds: Sequence[str] = KINDS,
        told: Callable[[TakeoverTally], None] = lambda tally: None,
    ) -> None:
        self._file = directory / "done"
        self._seed, self._spoilt_by, self._calm, self._kinds, self._told = seed, spoilt_by, calm, kinds, told
        self._lock = threading.Lock()
        self._waits = Waits()
        self.tally = TakeoverTally()
        self._cases = 0
        for line in self._file.read_text().splitlines() if self._file.exists() else []:
            self.tally.add(TakeoverTally.of(json.loads(line)))
            self._cases += 1

    def run(self, faults: int, fleets: int) -> TakeoverTally:
        """Make `faults` faults in all, including those of earlier runs; return the tally.

        Raises:
            PancakesError: a fleet could not be set up.
        """
        # A continued run must not repeat the faults of the earlier one.
        draw = random.Random(f"takeovers/{self._seed}/{self._cases}")
        deck = Deck(self._kinds, faults - self.tally.faults.total(), draw)
        with ThreadPoolExecutor(fleets) as pool:
            try:
                list(pool.map(lambda seed: self._strike(seed, deck), [draw.getrandbits(32) for _ in range(fleets)]))
            finally:
                self._waits.break_off()
        return self.tally

    def _strike(self, seed: int, deck: Deck) -> None:
        draw = random.Random(seed)
        # A fleet whose task stays paused is given up; the next fleet continues.
        while deck.left and len(self.tally.standstills) < MOST_STANDSTILLS:
            with tempfile.TemporaryDirectory(prefix="pancakes-takeovers-") as name:
                seed = draw.getrandbits(32)
                GuardedFleet(Path(name) / "f", seed, deck, self._waits, self._spoilt_by, self._calm).run(self._done)

    def _done(self, tally: TakeoverTally) -> None:
        with self._lock:
            with self._file.open("a") as file:
                file.write(json.dumps(tally.figures()) + "\n")
            self.tally.add(tally)
            self._told(self.tally)
