"""One entry of a journal, and how it is sealed so that nothing torn or foreign is ever believed."""

from __future__ import annotations

from typing import Final

import msgspec

from pancakes.errors import PancakesError
from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.digest import sha256
from pancakes.runtime.foundation.malformed import MALFORMED, why_malformed

_MAGIC: Final = b"PNCKJRN1"
_DIGEST_BYTES: Final = 32


class JournalError(PancakesError):
    """The journal cannot be opened, read or written; the message names the file."""


class JournalLost(JournalError):
    """The state directory is not the one any more that was opened: another process may open what lies there now."""


class JournalEntry(msgspec.Struct, frozen=True, array_like=True):
    """One durable thing. A later entry of the same kind and key takes its place.

    Attributes:
        kind: what it is (`task`, `fence`, `ledger`), in lower-case letters.
        key: which of its kind, such as a task's id.
        data: what is kept; the journal does not look into it.
    """

    kind: str
    key: str
    data: bytes


class SetAside(msgspec.Struct, frozen=True):
    """An entry that was found, could not be believed, and was put aside under another name.

    Attributes:
        name: where it lay.
        now: where it lies now; people may look at it, the journal never does.
        reason: why it was not believed.
        kind: what it claims to be, as far as its name tells; empty where it does not.
        key: which of that kind, as far as its name tells.
        entry: what can be read of it all the same: it is whole, but of another journal; None: nothing.
        times: how often an entry of this name was set aside, this time included.
    """

    name: str
    now: str
    reason: str
    kind: str
    key: str
    entry: JournalEntry | None = None
    times: int = 1

    def __str__(self) -> str:
        return f"{self.name} {self.reason}: it was set aside as {self.now}"


class Unbelievable(Exception):
    """Sealed bytes are not what they should be; the message goes on from the file's name."""


class _Sealed(msgspec.Struct, frozen=True, array_like=True):
    journal: str
    entry: JournalEntry


_DECODE: Final = codecs.decoder(_Sealed)


def seal(journal: str, entry: JournalEntry) -> bytes:
    """Returns an entry as it is stored by the journal with the id `journal`: marked, and with its checksum.

    Raises:
        JournalError: there is no memory for it.
    """
    try:
        body = codecs.encode(_Sealed(journal, entry))
    except MemoryError as error:
        raise JournalError(
            f"the {len(entry.data)} bytes of {entry.kind} {entry.key} cannot be written: {error}"
        ) from None
    return _MAGIC + sha256(body) + body


def unseal(journal: str, sealed: bytes) -> JournalEntry:
    """Returns the entry that was stored.

    Args:
        journal: id of the journal that must have stored it; empty where any will do.
        sealed: what was read.

    Raises:
        Unbelievable: the bytes are torn, damaged, or another journal's.
    """
    if not sealed.startswith(_MAGIC):
        raise Unbelievable("is no file of a journal" if sealed else "is empty")
    head = len(_MAGIC) + _DIGEST_BYTES
    body = sealed[head:]
    if sha256(body) != sealed[len(_MAGIC) : head]:
        raise Unbelievable(f"is torn or damaged ({len(sealed)} bytes, wrong checksum)")
    try:
        contents = _DECODE(body)
    except MALFORMED as error:
        raise Unbelievable(f"cannot be understood ({why_malformed(error)})") from None
    if journal and contents.journal != journal:
        raise Unbelievable(f"belongs to the journal {contents.journal}, this is {journal}")
    return contents.entry
