"""The addresses that an agent knows, and when each is dialled again. Pure."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, ItemsView, Sequence
from typing import Any, Final

import msgspec

from pancakes.mesh.wire.link import LinkTimes
from pancakes.mesh.wire.link_messages import fault_of_address

MAX_LEARNT: Final = 512
"""Most addresses kept that were learnt from others."""
MOST_OF_PEER: Final = 16
"""Most addresses that one peer has named and at which no agent is connected."""
FORGET_AFTER: Final = 20
"""A learnt address that failed so often in a row is forgotten; the longest wait is reached at the eighth."""

RESTS_S: Final = 600.0
"""A static address whose agent has ended the link as one too many is dialled again after so long."""


class KnownAddress(msgspec.Struct):
    """An address that can be dialled."""

    static: bool
    due_s: float
    name: str = ""  # of the agent that was last met there
    link: int | None = None  # of the dial under way, until a peer said hello there, or it failed
    failures: int = 0
    ours: bool = False  # it is this agent's own
    refused: str = ""  # why the agent there will not have us, in its words
    rests: bool = False  # the link to its agent has ended as one too many
    by: str = ""  # the peer that named it; empty: the configuration, or a person


class AddressBook:
    """The addresses that an agent knows.

    Args:
        own: the addresses at which it listens itself, which are none to dial.
        static: addresses that are always dialled.
        source: random numbers for the spread of retries.
        times: the times of membership.
        now_s: host time.
        is_up: returns whether the agent of a name is connected.
        may_be_named: returns whether a peer may name an address.
    """

    def __init__(
        self,
        own: Sequence[str],
        static: Sequence[str],
        source: random.Random,
        times: LinkTimes,
        now_s: float,
        is_up: Callable[[str], bool],
        may_be_named: Callable[[str], bool],
    ) -> None:
        self._own = own
        self._random = source
        self._times = times
        self._is_up = is_up
        self._may_be_named = may_be_named
        self._known = {address: KnownAddress(True, now_s) for address in static if address not in own}
        self._learnt = 0  # of those that are known

    def __contains__(self, address: str) -> bool:
        """Whether an address is known."""
        return address in self._known

    def __getitem__(self, address: str) -> KnownAddress:
        """What is known of an address."""
        return self._known[address]

    def get(self, address: str) -> KnownAddress | None:
        """Returns what is known of an address; None: nothing."""
        return self._known.get(address)

    def items(self) -> ItemsView[str, KnownAddress]:
        """Returns all addresses, and what is known of each."""
        return self._known.items()

    def describe(self) -> list[dict[str, Any]]:
        """Returns each address with what is known of it, as plain values. Any thread."""
        return [
            {
                "address": address,
                "static": it.static,
                "name": it.name,
                "failures": it.failures,
                "refused": it.refused,
                "rests": it.rests,
            }
            for address, it in list(self._known.items())
            if not it.ours
        ]

    def are_awaited(self) -> bool:
        """Returns whether there is a static address with no agent connected, where no dial failed yet. Any thread."""
        known = list(self._known.values())
        return any(it.static and not (it.ours or it.failures or it.refused or self._is_up(it.name)) for it in known)

    def learn(self, address: str, now_s: float, name: str = "", by: str = "") -> bool:
        """Writes an address down that a peer has named; returns whether it is a new one.

        Args:
            address: the address.
            now_s: host time.
            name: the agent that listens there, where it has said so itself.
            by: the peer that named it; empty: a person did.
        """
        it = self._known.get(address)
        is_new = it is None
        if it is None:
            if fault_of_address(address) or address in self._own or self._learnt >= MAX_LEARNT:
                return False
            if by and (not self._may_be_named(address) or self._unmet(by) >= MOST_OF_PEER):
                return False
            it = self._known[address] = KnownAddress(False, now_s, by=by)
            self._learnt += 1
        if not it.static:  # whose name is that of the agent that we have met there
            it.name = name or it.name
        return is_new

    def failed(self, address: str, now_s: float, hopeless: bool) -> None:
        """A dial has failed.

        Args:
            address: what was dialled.
            now_s: host time.
            hopeless: whether the next one would fail as well, as far as can be known.
        """
        it = self._known[address]
        it.failures += 1
        if not it.static and it.failures >= FORGET_AFTER and not self._is_up(it.name):
            del self._known[address]
            self._learnt -= 1
        elif hopeless:
            it.due_s = now_s + self._times.retry_longest_s
        else:
            self.retry(it, now_s)

    def forget(self, address: str) -> None:
        """Forgets a learnt address, once it is not being dialled."""
        it = self._known.get(address)
        if it is None or it.static:
            return
        if it.link is not None:
            it.failures = FORGET_AFTER
        else:
            del self._known[address]
            self._learnt -= 1

    def rest(self, address: str, now_s: float) -> None:
        """The agent there is not to be dialled for a while: forgets an address that was learnt."""
        it = self._known[address]
        if it.static:
            it.failures, it.due_s, it.rests = 0, now_s + RESTS_S, True
        else:
            self.forget(address)

    def retry(self, it: KnownAddress, now_s: float) -> None:
        """Puts the next dial off by a random time with a doubling bound: full jitter."""
        doublings = min(max(it.failures - 1, 0), 30)
        bound_s = min(self._times.retry_first_s * 2**doublings, self._times.retry_longest_s)
        it.due_s = now_s + self._random.uniform(0.0, bound_s)

    def make_due(self, address: str, now_s: float) -> None:
        """Has an address dialled now, where it is known."""
        if (it := self._known.get(address)) is not None:
            it.due_s = min(it.due_s, now_s)

    def all_due(self, now_s: float) -> None:
        """Makes all addresses due now."""
        for it in self._known.values():
            it.failures, it.due_s = 0, now_s

    def is_wanted(self, it: KnownAddress) -> bool:
        """Returns whether an address is to be dialled when it is due."""
        return it.link is None and not self._is_up(it.name) and it.due_s != math.inf

    def _unmet(self, peer: str) -> int:
        """Returns at how many addresses that a peer has named no agent is connected."""
        return sum(it.by == peer and not self._is_up(it.name) for it in self._known.values())
