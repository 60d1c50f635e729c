"""Cut the link between two real agents at each step of a migration; the table `ENDS` says how each must end."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from torture.grounds import Cuttable, Survey, by_proxy
from torture.live import LiveFleet
from torture.waits import Waits

from pancakes.client import Client, Target
from pancakes.control import Describe, Migrate
from pancakes.errors import PancakesError

STEPS = {
    "solicit": "migration.solicit",
    "bid": "migration.bid",
    "accept": "task.accept",
    "prepare": "task.prepare",
    "promise": "task.promise",
    "known": "task.known",
}
"""The steps of a migration, each with the packet that is lost."""
FATES = ("heals at once", "heals after 3 s", "source dies", "destination dies")
NAMES = ("source", "destination")
NOBODY = "nobody"
SETTLES_WITHIN_S = 25.0


class End(NamedTuple):
    """Where the task runs.

    Attributes:
        meanwhile: the agents that may run it while the link is cut and the killed agent is dead.
        finally_: the agents that may run it after the link has healed and all agents are back.
    """

    meanwhile: tuple[str, ...]
    finally_: tuple[str, ...]


def ends(step: str, fate: str, tells_losses: bool = True) -> End:
    """Return how a cut at a step must end; the task was to migrate from `source` to `destination`.

    Args:
        step: at which word.
        fate: what happens then.
        tells_losses: whether the message is lost for good, see `Ground`.
    """
    given_away = step in ("promise", "known")  # the source has written its promise: there is no way back
    taken = step == "known"
    if fate == "heals at once":
        # In the middle, a lost message is repeated, or the source takes the task back: both are right.
        either = not tells_losses or step in ("accept", "prepare")
        return End(
            ("source", "destination", NOBODY),
            ("destination",) if given_away else NAMES if either else ("source",),
        )
    final = ("destination",) if given_away else ("source",)
    if fate == "heals after 3 s":
        return End(("destination",) if taken else (NOBODY,) if given_away else ("source",), final)
    if fate == "source dies":
        return End(("destination",) if taken else (NOBODY,), final)
    return End((NOBODY,) if given_away else ("source",), final)


class Case(NamedTuple):
    """One cut, and how it ended.

    Attributes:
        step: the message of the protocol at which the link was cut.
        fate: what happened then.
        meanwhile: where the task ran while the link was cut.
        finally_: where it ran at the end.
        settled_s: how long after the healing it ran there.
        faults: a sentence for each fault.
    """

    step: str
    fate: str
    meanwhile: str
    finally_: str
    settled_s: float
    faults: tuple[str, ...]


class Cutter:
    """Makes cuts, several at once.

    Args:
        survey: makes the network of the two agents of each cut.
    """

    def __init__(self, survey: Survey = by_proxy) -> None:
        self._survey = survey
        self._waits = Waits()

    def run(self, cases: Sequence[tuple[str, str]], jobs: int) -> Iterator[Case]:
        """Make cuts, each a step and a fate, and yield how they ended, in their order.

        Where whoever takes them stops early, or is interrupted, those under way are broken off.
        """
        with ThreadPoolExecutor(jobs) as pool:
            try:
                yield from pool.map(lambda case: self._cut(*case), cases)
            finally:
                self._waits.break_off()
                pool.shutdown(cancel_futures=True)

    def _cut(self, step: str, fate: str) -> Case:
        """Cut the link once, between two agents that are started for it."""
        ground = self._survey(NAMES)
        with tempfile.TemporaryDirectory(prefix="pancakes-cut-") as name:
            task = f'[task.One]\ntype = "torture.Holder"\nsettings = {{directory = "{name}"}}\n'
            fleet = ground.fleet(Path(name), {"source": task, "destination": ""})
            try:
                assert ground.link is not None
                return self._run(fleet, ground.link, step, fate, ends(step, fate, ground.tells_losses))
            finally:
                fleet.close()
                ground.close()

    def _run(self, fleet: LiveFleet, link: Cuttable, step: str, fate: str, expected: End) -> Case:
        faults: list[str] = []
        for name in fleet.names:
            fleet.start(name, wait=True)
        with Client(Target((fleet.addresses["source"],), "torture"), 10.0) as client:
            wait_for_both(client, "source", "destination")
            link.cut_at(STEPS[step])
            asking = threading.Thread(target=_ask, args=(client,), daemon=True)
            asking.start()
            if not link.cut.wait(10.0):
                faults.append(f"{step} was never said")
            victim = {"source dies": "source", "destination dies": "destination"}.get(fate)
            if victim is not None:
                fleet.kill(victim)
            meanwhile = NOBODY
            if fate != "heals at once":
                self._waits.let(2.6)  # what is frozen is taken back after 2 s
                meanwhile = self._runs(fleet, 0.4)
            link.heal()
            if victim is not None:
                fleet.start(victim)
            finally_, settled_s = self._settled(fleet, expected)
            asking.join(10.0)
        if meanwhile not in expected.meanwhile:
            faults.append(f"while it was cut {meanwhile} ran it, not {' or '.join(expected.meanwhile)}")
        if finally_ not in expected.finally_:
            faults.append(f"in the end {finally_} runs it, not {' or '.join(expected.finally_)}")
        doubled = fleet.directory / "One.doubled"
        if doubled.exists():
            faults.append(doubled.read_text().strip())
        return Case(step, fate, meanwhile, finally_, settled_s, tuple(faults))

    def _settled(self, fleet: LiveFleet, expected: End) -> tuple[str, float]:
        """Watch until the task runs where it must; return the agent, and after how many seconds this was so."""
        healed_s = time.monotonic()
        runs, settled_s = NOBODY, 0.0
        while (now_s := time.monotonic()) < healed_s + SETTLES_WITHIN_S:
            before, runs = runs, self._runs(fleet, 0.4)
            if runs != before:
                settled_s = now_s - healed_s
            # Watch for longer than anything could take that might still change it.
            if runs in expected.finally_ and now_s > healed_s + max(2.5, settled_s + 1.0):
                break
        return runs, settled_s

    def _runs(self, fleet: LiveFleet, for_s: float) -> str:
        """Watch for a while which agents run the task, by the task's own file."""
        count = fleet.directory / "One.count"
        before = count.stat().st_size
        self._waits.let(for_s)
        with count.open("rb") as file:
            file.seek(before)
            lines = file.read().decode().splitlines()
        return lines[-1].split()[2] if lines else NOBODY


def wait_for_both(client: Client, one: str, other: str) -> None:
    """Wait until two agents have found each other, and the new tasks of the first one exist."""
    until_s = time.monotonic() + 20.0
    while time.monotonic() < until_s:
        try:
            found = client.request(one, Describe()).result
            tasks = [task for task in found["tasks"] if task["service"] == "client"]
            if found["neighbours"] == [other] and all(task["state"] == "running" for task in tasks):
                return
        except PancakesError:  # the agent is only just starting
            pass
        time.sleep(0.05)
    raise TimeoutError(f"{one} and {other} did not find each other within 20 s, or its tasks do not run")


def _ask(client: Client) -> None:
    try:
        client.request("source", Migrate("client/One"))
    except PancakesError:  # the agent was killed, as planned
        pass
