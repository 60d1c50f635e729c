"""What the searches start from, and what may happen in each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from pancakes.durable.register import Identity, Members


@dataclass(frozen=True)
class Scenario:
    """One search.

    Attributes:
        title: what it is called.
        agents: the names of the agents, a letter each.
        owner: the agent on which the task runs at first.
        members: the members of its register; the owner alone: it is not guarded.
        takers: the agents that may be called to take the task.
        heirs: the agents to which the task may be offered.
        letters: how many packets are sent to the task.
        numbers: the highest number in an epoch, a person's decisions apart.
        draws: how many different ones an agent draws for epochs of one number, as it forgets what it asked for.
        window: how many beats may run at a time.
        crashes: whether agents crash.
        crash: which agents do; empty: all.
        known: whether refusals and answers travel. They only hasten what a guarded task does.
        swap: the members that may take over from the first ones. A digit makes an identity with another disk.
        wipes: the agents that may lose their disks.
        begins: the agents on which the task may begin.
        forces: the agents on which a person may decide that the task lives.
        wrong: whether that person may be wrong.
        copies: the agents whose disk may be replaced by an old copy.
        noticed: whether an agent notices that its disk is a copy.
        liar: the agent that lies; empty: none.
        lies: what it says.
        left: how often each of the rare events may happen.
        lags: whether a state may come later than the request for a lease that goes with it.
        must: what the search must have come to.
    """

    title: str
    agents: str = "AB"
    owner: str = "A"
    members: str = "A"
    takers: str = ""
    heirs: str = ""
    letters: int = 0
    numbers: int = 3
    draws: int = 3
    window: int = 1
    crashes: bool = True
    crash: str = ""
    known: bool = True
    swap: str = ""
    wipes: str = ""
    begins: str = ""
    forces: str = ""
    wrong: bool = False
    copies: str = ""
    noticed: bool = True
    liar: str = ""
    lies: str = "Accept Accepted Known Prepare Promise"
    left: Mapping[str, int] = field(default_factory=dict)
    lags: bool = False
    must: str = ""


def identities(text: str) -> Members:
    """Return the identities in a text such as `AB1C`: B with another disk."""
    found: list[Identity] = []
    for letter in text:
        if letter.isalpha():
            found.append(Identity(letter))
        else:
            found[-1] = found[-1]._replace(journal=letter)
    return tuple(sorted(found))


UNGUARDED: Final = (
    Scenario("move, letters", heirs="B", letters=2, left={"moves": 2}, must="A B HEIR YIELDED RELEASED"),
    Scenario("there and back", heirs="AB", letters=1, numbers=4, left={"moves": 3}, must="A B HEIR YIELDED RELEASED"),
    Scenario("moves of three", "ABC", heirs="BC", left={"moves": 2}, must="A B C HEIR YIELDED RELEASED"),
    Scenario("move, stop and start", heirs="B", left={"moves": 2, "stops": 2, "starts": 1}, must="A B HEIR stopped"),
    Scenario(
        "move, stop, late states",
        heirs="B",
        letters=2,
        left={"moves": 1, "stops": 1, "starts": 1},
        must="A B HEIR stopped",
    ),
    Scenario(
        "move, remove, begin again",
        heirs="B",
        begins="A",
        left={"moves": 2, "stops": 1, "removes": 1, "begins": 1},
        must="A B removed begun",
    ),
    Scenario(
        "disk of the heir lost, right word",
        heirs="B",
        wipes="B",
        forces="A",
        left={"moves": 1, "wipes": 1, "forces": 1},
        numbers=10,
        must="wiped forced",
    ),
    Scenario(
        "disk of the birthplace lost",
        heirs="B",
        wipes="A",
        begins="A",
        forces="B",
        letters=1,
        numbers=10,
        left={"moves": 1, "wipes": 1, "begins": 1, "forces": 1},
        must="wiped begun",
    ),
    Scenario(
        "wrong word, then a right one",
        heirs="B",
        forces="AB",
        wrong=True,
        numbers=10,
        letters=1,
        left={"moves": 1, "forces": 2},
        must="forced DISPUTED",
    ),
    Scenario(
        "wrong word, a late state",
        heirs="B",
        forces="AB",
        wrong=True,
        numbers=10,
        letters=1,
        left={"moves": 1, "stops": 1, "forces": 2},
        must="forced DISPUTED",
    ),
    Scenario(
        "a copy that nobody notices",
        heirs="AB",
        copies="A",
        noticed=False,
        crashes=False,
        left={"moves": 2, "backups": 1, "restores": 1},
        must="restored DISPUTED",
    ),
    Scenario(
        "a copy that is noticed",
        heirs="AB",
        copies="A",
        begins="A",
        letters=1,
        left={"moves": 1, "backups": 1, "restores": 1, "begins": 1},
        must="restored begun",
    ),
)


def guarded(title: str, **changes: Any) -> Scenario:
    """Return a scenario of a guarded task."""
    usual: dict[str, Any] = {
        "agents": "ABC",
        "members": "ABC",
        "known": False,
        "numbers": 1,
        "draws": 1,
        "crashes": False,
    }
    return Scenario(f"guarded: {title}", **(usual | changes))


GUARDED: Final = (
    guarded("a taker, letters", takers="B", letters=1, crashes=True, must="A B"),
    guarded("a taker that asks anew", takers="B", draws=2, crashes=True, must="A B"),
    guarded("a taker, two beats", takers="B", window=2, crashes=True, must="A B"),
    guarded("two takers", takers="BC", crashes=True, must="A B C"),
    guarded("the owner and a taker", takers="AB", must="A B"),
    guarded("migration to a member", owner="B", heirs="A", left={"moves": 1}, crashes=True, must="A B offered"),
    guarded("migration, a taker", owner="B", heirs="A", takers="C", left={"moves": 1}, must="A B C offered"),
    guarded(
        "migration to a stranger, a taker",
        agents="ABCD",
        owner="B",
        heirs="D",
        takers="A",
        left={"moves": 1},
        must="A B D offered",
    ),
    guarded("migration, given up", owner="B", heirs="A", left={"moves": 1}, window=2, must="A B"),
    guarded(
        "migration to a stranger, given up",
        agents="ABCD",
        owner="B",
        heirs="D",
        left={"moves": 1},
        window=2,
        must="B D",
    ),
    guarded("migration, a letter", owner="B", heirs="A", letters=1, left={"moves": 1}, must="A B"),
    guarded("a taker, refusals are heard", known=True, numbers=1, takers="B", must="A B"),
    guarded("a former owner replaced", agents="ABCD", swap="BCD", takers="B", left={"swaps": 1}, must="A B swapped"),
    guarded("a member replaced", agents="ABCD", swap="ABD", takers="C", left={"swaps": 1}, must="A C swapped"),
    guarded("migration given up, states late", owner="B", heirs="A", left={"moves": 1}, lags=True, must="A B"),
    guarded("a member's disk lost, a letter", wipes="B", takers="C", letters=1, left={"wipes": 1}, must="A C wiped"),
    guarded(
        "a member's disk lost",
        wipes="B",
        swap="AB1C",
        takers="C",
        left={"swaps": 1, "wipes": 1},
        must="A C wiped swapped",
    ),
    guarded("the guard set up", members="A", swap="ABC", takers="B", left={"swaps": 1}, must="A B swapped"),
    guarded("the guard given up", swap="A", takers="B", left={"swaps": 1}, must="A B swapped"),
    guarded(
        "migration and replacement",
        agents="ABCD",
        owner="B",
        heirs="A",
        swap="ABD",
        left={"moves": 1, "swaps": 1},
        must="A B swapped offered",
    ),
    guarded("stop, start, a taker", takers="B", left={"stops": 1, "starts": 1}, must="A B stopped"),
    guarded("stop during a migration", owner="B", heirs="A", left={"moves": 1, "stops": 1}, must="A B stopped"),
    guarded("stop, a late state, a taker", takers="B", letters=1, left={"stops": 1}, must="A B stopped"),
    guarded("removed, a taker", takers="B", left={"stops": 1, "removes": 1}, must="A B removed"),
    guarded("a goodbye, a taker", takers="B", crashes=True, crash="A", left={"goodbyes": 1}, must="A B offered"),
    guarded("a goodbye, two beats", takers="B", window=2, left={"goodbyes": 1}, must="A B offered"),
    guarded(
        "a copy of the owner's disk", copies="A", takers="B", left={"backups": 1, "restores": 1}, must="B restored"
    ),
    guarded(
        "a copy of a member's disk",
        copies="C",
        takers="B",
        letters=1,
        left={"backups": 1, "restores": 1},
        must="A B restored",
    ),
    guarded(
        "migration, refusals are heard", known=True, numbers=2, owner="B", heirs="A", left={"moves": 1}, must="A B"
    ),
    guarded("a wrong word", numbers=10, known=True, forces="C", wrong=True, left={"forces": 1}, must="forced DISPUTED"),
    guarded(
        "most members lost, a word",
        takers="B",
        wipes="BC",
        forces="A",
        left={"wipes": 2, "forces": 1},
        must="B wiped forced",
    ),
)

LIARS: Final = (
    Scenario("liar: a stranger, a move", "ABL", heirs="B", letters=1, liar="L", left={"moves": 1}, must="A B"),
    Scenario("liar: the heir", "AL", heirs="L", letters=1, liar="L", numbers=2, left={"moves": 1}, must="A"),
    Scenario("liar: an old owner's place", "ABL", heirs="BA", liar="L", numbers=4, left={"moves": 2}, must="A B"),
    guarded("liar: a stranger, a taker", agents="ABCL", takers="B", liar="L", letters=1, numbers=2, must="A B"),
    guarded(
        "liar: a stranger, a migration",
        agents="ABCL",
        owner="B",
        heirs="A",
        liar="L",
        numbers=2,
        left={"moves": 1},
        must="A B",
    ),
)
"""An agent that says whatever its certificate lets it say, in its own name."""

SUITE: Final = (*UNGUARDED, *GUARDED)

DEEP: Final = (
    guarded(
        "deep: a former owner replaced, news",
        agents="ABCD",
        known=True,
        numbers=2,
        swap="BCD",
        takers="B",
        left={"swaps": 1},
        must="A B swapped",
    ),
    guarded(
        "deep: a member replaced, states late",
        agents="ABCD",
        swap="ABD",
        takers="C",
        left={"swaps": 1},
        crashes=True,
        crash="D",
        lags=True,
        must="A C swapped",
    ),
    guarded(
        "deep: the guard set up, the owner crashes",
        members="A",
        swap="ABC",
        takers="B",
        left={"swaps": 1},
        crashes=True,
        crash="A",
        must="A B swapped",
    ),
    guarded("deep: refusals are heard", known=True, numbers=2, takers="B", must="A B"),
    guarded("deep: a goodbye, all crash", takers="B", left={"goodbyes": 1}, crashes=True, must="A B offered"),
    Scenario(
        "deep: a copy that nobody notices, crashes",
        heirs="AB",
        copies="A",
        noticed=False,
        left={"moves": 2, "backups": 1, "restores": 1},
        must="restored DISPUTED",
    ),
)
"""Minutes, and some gigabytes of memory."""

IMPOSSIBLE: Final = (
    guarded(
        "liar: one of three members",
        agents="ABL",
        members="ABL",
        takers="B",
        liar="L",
        lies="Accepted Promise",
        window=2,
        numbers=1,
    ),
)
"""What no rules can keep: of three members, one that lies is in each quorum of the other two."""
