"""The scenarios of guarded tasks: hand-off, take-over, guardians replaced, disks lost or copied, stop, goodbye."""

from __future__ import annotations

from typing import Final

from model.guarded_parts import Scenario

SUITE: Final = {
    it.title: it
    for it in (
        Scenario("a taker, and crashes", takers="B"),
        Scenario("two takers", crashes=""),
        Scenario("what was replicated", takers="B", packets=1, crashes=""),
        Scenario("a hand-off, and crashes", owner="B", takers="", moves="A", numbers=2),
        Scenario("a hand-off and a packet", owner="B", takers="", moves="A", numbers=2, packets=1, crashes=""),
        Scenario("a hand-off and a taker", owner="B", takers="C", moves="A", numbers=2, window=1, crashes=""),
        Scenario(
            "guardians replaced, and not all know", agents="ABCD", swap="ABD", swapped=True, takers="C", crashes=""
        ),
        Scenario("the guard set up", guards="A", swap="ABC", takers="B", crashes=""),
        Scenario("the disk of a guardian lost", wipes="B", takers="C", crashes=""),
        Scenario("the disk of the owner lost", wipes="A", takers="B", crashes="B"),
        Scenario("the disk of a guardian copied", copies="C", takers="B", crashes=""),
        Scenario("the disk of the owner copied", copies="A", takers="B", crashes=""),
        Scenario("the disk of a taker copied", copies="B", takers="B", crashes=""),
        Scenario("the disk of a source copied", "ABC", "B", copies="B", takers="", moves="A", numbers=2, crashes=""),
        Scenario(
            "the disk of a destination copied", "ABC", "B", copies="A", takers="", moves="A", numbers=2, crashes=""
        ),
        Scenario("stopped and started", takers="B", stops=True, crashes=""),
        Scenario("a goodbye", takers="B", goodbyes=1, crashes=""),
        Scenario("adopted", takers="", moves="B", wipes="BC", adopts=True, numbers=2, crashes=""),
    )
}
"""Two minutes of one core in all: searched by the tests too."""

DEEP: Final = {
    it.title: it
    for it in (
        Scenario("a taker, crashes and two askings", takers="B", own=2),
        Scenario("two takers, and crashes"),
        Scenario("two takers and two askings", own=2, crashes=""),
        Scenario("what was replicated, and crashes", takers="B", packets=1),
        Scenario("a KEEP without its body, two askings", takers="B", packets=1, bare=True, crashes=""),
        Scenario("a hand-off, a taker and two askings", owner="B", takers="C", moves="A", numbers=2, crashes=""),
        Scenario("guardians replaced, two askings", agents="ABCD", swap="ABD", takers="C", crashes=""),
        Scenario("the disk of a guardian lost, and replaced", wipes="B", swap="AB1C", takers="C", crashes=""),
        Scenario("two branches", packets=2, crashes=""),
        Scenario("the owner comes back", takers="AB", called=2, packets=1, crashes=""),
        Scenario("a hand-off, a taker and crashes", owner="B", takers="C", moves="A", numbers=2),
        Scenario("a hand-off to a stranger, a taker", "ABCD", "B", takers="A", moves="D", numbers=2, crashes=""),
        Scenario("a hand-off while guardians are replaced", "ABCD", "B", takers="", moves="A", swap="ABD", numbers=2),
        Scenario("guardians replaced, and crashes", agents="ABCD", swap="ABD", takers="C"),
        Scenario("the disk of a guardian lost, and crashes", wipes="B", swap="AB1C", takers="C"),
        Scenario("the disk of a guardian copied, and a packet", copies="C", takers="B", packets=1),
        Scenario("the disk of the owner copied, and a packet", copies="A", takers="B", packets=1, crashes=""),
        Scenario("the disk of a taker copied, and a packet", copies="B", takers="B", packets=1, crashes=""),
        Scenario(
            "the disk of a source copied, a taker", "ABC", "B", copies="B", takers="C", moves="A", numbers=2, crashes=""
        ),
        Scenario(
            "the disk of a destination copied, and crashes", "ABC", "B", copies="A", takers="", moves="A", numbers=2
        ),
        Scenario("guardians replaced, a disk copied", agents="ABCD", swap="ABD", copies="B", takers="C", crashes=""),
        Scenario("the guard set up, and crashes", guards="A", swap="ABC", takers="B"),
        Scenario("a goodbye, and crashes", takers="B", goodbyes=1),
        Scenario("a goodbye and two askings", takers="B", goodbyes=1, own=2),
        Scenario("a goodbye and two takers", goodbyes=2, crashes=""),
        Scenario("stopped, and crashes", takers="B", stops=True),
        Scenario("a taker whose own messages are late", takers="B", at_once=False),
        Scenario("adopted, and crashes", takers="", moves="B", wipes="BC", adopts=True, numbers=2),
    )
}
"""Minutes each, and gigabytes of memory. One with more than three million states is searched so far, and says so."""
