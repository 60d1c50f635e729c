"""What is known of the letters that have come for one task."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import msgspec

from pancakes.mesh.migration.event import PacketId
from pancakes.mesh.migration.post import STREAMS, Letter
from pancakes.packet import Packet
from pancakes.runtime.kernel.dead_letters import MOST_KNOWN
from pancakes.runtime.kernel.reference import Reference

KEPT: Final = 1024
"""Most letters of one task that are acknowledged before they are on disk, ..."""
KEPT_BYTES: Final = 4 * 1024 * 1024
"""... and most bytes of them; with more, the task is written down at once, and only then are they acknowledged."""


MOST_GIVEN: Final = 1024
"""So many letters of one agent a task has still to look at, ..."""
MOST_GIVEN_BYTES: Final = 16 * 1024 * 1024
"""... and so many bytes of them; of more, the agent keeps them and sends them again. One may always be given."""


class TaskLetters(msgspec.Struct):
    """The letters that have come for one task.

    Attributes:
        owed: handled, and not known to be on disk: up to which number, and which agent waits to hear of it, by stream.
        kept: acknowledged before they are on disk, by stream and number, and the packets in them.
        kept_bytes: how many bytes they have.
        asked: whether the task is being written down because there is no more room for them.
        failures: how often the task has failed on a letter, by stream and number.
        given_to: the task's actor that was given the following.
        given: what it has still to look at: which letter, and what its sender said then of those before it.
        given_of: how many of these are of each agent, and how many bytes they have.
    """

    owed: dict[str, tuple[int, str]] = {}
    kept: dict[tuple[str, int], tuple[Letter, Packet | None]] = {}
    kept_bytes: int = 0
    asked: bool = False
    failures: dict[tuple[str, int], int] = {}
    given_to: Reference | None = None
    given: dict[tuple[str, int, int], Packet | None] = {}
    given_of: dict[str, tuple[int, int]] = {}

    def give(self, task: Reference, letter: Letter, packet: Packet | None) -> bool:
        """Learns that an actor is given a letter; returns False where it has that still to look at, or too many."""
        if self.given_to is not task:
            self.given_to, self.given, self.given_of = task, {}, {}
        place = (letter.stream, letter.seq, letter.first)
        if place in self.given:
            return False
        count, size = self.given_of.get(letter.sender, (0, 0))
        size += len(letter.packet)
        if count >= MOST_GIVEN or (count and size > MOST_GIVEN_BYTES):
            return False
        self.given[place], self.given_of[letter.sender] = packet, (count + 1, size)
        return True

    def looked_at(self, task: Reference, letter: Letter) -> Packet | None:
        """Learns that an actor has looked at a letter; returns the packet in it."""
        place = (letter.stream, letter.seq, letter.first)
        if self.given_to is not task or place not in self.given:
            return None
        count, size = self.given_of.pop(letter.sender)
        if count > 1:
            self.given_of[letter.sender] = (count - 1, size - len(letter.packet))
        return self.given.pop(place)

    def note_failures(self, letter: Letter, failures: int) -> None:
        """Learns how often the task has failed on a letter."""
        key = (letter.stream, letter.seq)
        self.failures.pop(key, None)
        self.failures[key] = failures
        if len(self.failures) > MOST_KNOWN:  # a letter whose sender has gone never comes again, and nothing says so
            del self.failures[next(iter(self.failures))]

    def took(self, letter: Letter) -> None:
        """Learns that the task has handled a letter, now or before: what it remembers need not be on disk yet."""
        self.failures.pop((letter.stream, letter.seq), None)
        seq, _ = self.owed.get(letter.stream, (0, ""))
        self.owed[letter.stream] = (max(letter.seq, seq), letter.sender)
        if len(self.owed) > STREAMS:  # its filter has forgotten that stream
            del self.owed[next(iter(self.owed))]

    def keep(self, letter: Letter, packet: Packet | None) -> bool:
        """Keeps a letter that is acknowledged before it is on disk; returns False where there is no room for it."""
        key = (letter.stream, letter.seq)
        if key not in self.kept:
            if len(self.kept) >= KEPT or self.kept_bytes >= KEPT_BYTES:
                return False
            self.kept[key] = (letter, packet)
            self.kept_bytes += len(letter.packet)
        return True

    def consumed(self, heard: Mapping[str, int]) -> tuple[PacketId, ...]:
        """Returns what is on disk once a task is that has `heard` so much."""
        return tuple(PacketId(stream, seq) for stream, (seq, _) in self.owed.items() if seq <= heard.get(stream, 0))

    def on_disk(self, packet: PacketId) -> str:
        """Learns that a letter, and all before it in its stream, have had their effect for good.

        Returns:
            The agent that waits to hear of it; empty: none, for it was told, or the task was given away meanwhile.
        """
        for key in [key for key in self.kept if key[0] == packet.stream and key[1] <= packet.seq]:
            self.kept_bytes -= len(self.kept.pop(key)[0].packet)
            self.asked = False
        seq, sender = self.owed.get(packet.stream, (0, ""))
        if sender and seq <= packet.seq:
            del self.owed[packet.stream]
        return sender
