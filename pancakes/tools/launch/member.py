"""One agent of a fleet that is to be launched: frozen dataclasses, no decisions."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from pancakes.runtime.config import Config

Policy = Literal["no", "on-failure", "always"]


@dataclass(frozen=True, slots=True)
class ProcessRestart:
    """What the launcher does when an agent's process has ended by itself.

    Attributes:
        policy: `on-failure`: it is started again where its exit code is not 0, as after a crash; `always`: also where
            it ended in order, as after `pancakes down`; `no`: never.
        at_most: how many restarts are tried ...
        within_s: ... in so many seconds in which it is ready; one more end, and the agent is given up. The pauses, and
            starts that fail, take none of this time.
        pause_s: how long the first restart waits, in seconds. Each further one in `within_s` waits twice as long as the
            one before, less up to a quarter, by chance.
        pause_max_s: no restart waits longer than this.
    """

    policy: Policy = "on-failure"
    at_most: Annotated[int, Meta(ge=0)] = 3
    within_s: Annotated[float, Meta(gt=0, le=1e9)] = 60.0
    pause_s: Annotated[float, Meta(ge=0, le=1e9)] = 0.1
    pause_max_s: Annotated[float, Meta(ge=0, le=1e9)] = 10.0


@dataclass(frozen=True, slots=True)
class Member:
    """One agent of a fleet.

    Attributes:
        name: the agent's name.
        path: its configuration file.
        sets: what is changed of that file, as `--set` takes it.
        config: the configuration that follows.
        restart: what happens when its process ends.
        after: the agents that must be ready before it is started, and that end after it.
        host: where it runs, as `ssh` takes it: `pi@robot1`; empty: on this machine.
        unchecked: what its configuration names and is not installed here, so that it could not be checked.
    """

    name: str
    path: Path
    sets: tuple[str, ...]
    config: Config
    restart: ProcessRestart = field(default_factory=ProcessRestart)
    after: tuple[str, ...] = ()
    host: str = ""
    unchecked: tuple[str, ...] = ()
