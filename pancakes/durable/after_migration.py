"""What an agent must still do after a task has left it, or was stopped. It lies in the task's record. Pure."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from pancakes.errors import MigrationError
from pancakes.migration import MigrationReport
from pancakes.util import codecs
from pancakes.util.codecs import MALFORMED, why_malformed


class Sequel(msgspec.Struct, frozen=True):
    """What follows a hand-over or a stop, for the service of the task. The core carries it, and does not look in.

    Attributes:
        then: a task to start; empty: none.
        ledger: the account of the move as it stood when the task was paused for it; None: there is none.
    """

    then: str = ""
    ledger: MigrationReport | None = None

    def encode(self) -> bytes:
        """Returns it as msgpack bytes, for the record."""
        return codecs.encode(self)

    @classmethod
    def decode(cls, data: bytes) -> Sequel:
        """Reads what `encode` wrote; nothing at all is a sequel in which nothing follows.

        Raises:
            MigrationError: the bytes are no sequel.
        """
        if not data:
            return cls()
        try:
            return _DECODE(data)
        except MALFORMED as error:
            raise MigrationError(
                f"these {len(data)} bytes do not say what follows a hand-over: {why_malformed(error)}"
            ) from None


_DECODE: Callable[[bytes], Sequel] = codecs.decoder(Sequel)
