"""Where agents are looked for: at addresses or on this machine, in one fleet or in all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pancakes.errors import PancakesError
from pancakes.mesh.address import dialled
from pancakes.runtime.foundation.names import fault_of_name


@dataclass(frozen=True, slots=True)
class Where:
    """Where agents are looked for.

    Attributes:
        addresses: addresses to begin with (`tcp://127.0.0.1:7401`); none: what runs on this machine.
        fleet: only agents of this fleet; empty: of any.
    """

    addresses: tuple[str, ...] = ()
    fleet: str = ""

    @classmethod
    def of(cls, at: Where | str | Sequence[str]) -> Where:
        """Returns the place that is meant by an address, by several, or by what is one already.

        Raises:
            PancakesError: one of them is no address at which an agent could be, or the fleet has no name.
        """
        if isinstance(at, Where):
            if at.fleet and (fault := fault_of_name(at.fleet)):
                raise PancakesError(fault)
            return cls(_addresses(at.addresses), at.fleet)
        return cls(_addresses((at,) if isinstance(at, str) else at))


def _addresses(texts: Sequence[str]) -> tuple[str, ...]:
    try:
        return tuple(dict.fromkeys(dialled(text) for text in texts))
    except ValueError as error:
        raise PancakesError(str(error)) from None
