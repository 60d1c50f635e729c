"""How often a whole move enters files: what it costs a reader to follow one."""

import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import pancakes
from pancakes.control import Migrate
from pancakes.task import Task, every
from pancakes.testing import FleetInTest

ROOT = Path(pancakes.__file__).parent
CARRIES_A_MOVE = (
    "runtime/hosting/",
    "runtime/life/",
    *(f"runtime/supervision/{name}.py" for name in ("closing", "keeper", "slot", "startup")),
    "service.py",
)
CORE = ("core.py", "owner.py", "source.py", "candidate.py")
AT_MOST = 185


class Count(Task):
    """Counts its ticks."""

    @dataclass
    class State:
        n: int = 0

    state: State

    @every(hz=10)
    def tick(self, tick: Any) -> None:
        self.state.n += 1


def carries_a_move(file: str) -> bool:
    return file.startswith(CARRIES_A_MOVE) or file in [f"mesh/migration/{name}" for name in CORE]


def test_a_whole_move_enters_files_so_often() -> None:
    entered: Counter[str] = Counter()

    def note(frame: FrameType, event: str, arg: Any) -> None:
        path = Path(frame.f_code.co_filename)
        caller = frame.f_back
        if event == "call" and path.is_relative_to(ROOT):
            if caller is None or caller.f_code.co_filename != frame.f_code.co_filename:
                entered[path.relative_to(ROOT).as_posix()] += 1

    with FleetInTest(seed=5) as fleet:
        a = fleet.start("a", tasks={"Count": Count})
        fleet.start("b")
        fleet.connect()
        fleet.run_for(1.05)
        asked = a.publish("sysctrl", Migrate("Count"))
        sys.setprofile(note)
        try:
            reply = a.reply_to(asked)
            fleet.run_for(0.3)
        finally:
            sys.setprofile(None)
        assert reply.ok
    counted = {file: count for file, count in entered.most_common() if carries_a_move(file)}
    for file, count in counted.items():
        print(f"{count:5} {file}")
    assert sum(counted.values()) <= AT_MOST
