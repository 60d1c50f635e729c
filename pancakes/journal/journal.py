"""The journal: durable entries, an id for life and a counter of boots; and a journal in memory.

Subclasses store the entries: `MemoryJournal` here (virtual time and tests), `FileJournal` in
`pancakes.journal.file_journal`. Each entry is sealed with a checksum and the id of its journal, so torn or foreign
entries are detected. They are set aside under another name and reported. All methods wait for the disk, and only one
thread at a time calls them.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from itertools import chain, count
from typing import Any, Final, NamedTuple
from urllib.parse import quote, unquote

import msgspec

from pancakes import __version__
from pancakes.errors import PancakesError
from pancakes.util import codecs
from pancakes.util.codecs import MALFORMED, sha256, why_malformed

_MAGIC: Final = b"PNCKJRN1"
_DIGEST_BYTES: Final = 32


class JournalError(PancakesError):
    """The journal cannot be opened, read or written; the message names the file."""


class JournalLostError(JournalError):
    """The state directory is no longer the one that was opened: another process may open the new one."""


class JournalEntry(msgspec.Struct, frozen=True, array_like=True):
    """One durable entry. A later entry of the same kind and key replaces it.

    Attributes:
        kind: its kind (`task`, `fence`, `ledger`), in lower-case letters.
        key: which of its kind, such as a task's id.
        data: the contents, which the journal does not read.
    """

    kind: str
    key: str
    data: bytes


class SetAside(msgspec.Struct, frozen=True):
    """An entry that was not valid and was set aside under another name.

    Attributes:
        name: its old name.
        now: its new name; people may look at it, the journal never does.
        reason: why it was not valid.
        kind: its kind, according to its name; empty: unknown.
        key: its key, according to its name; empty: unknown.
        entry: its contents if they are whole but of another journal; None: not readable.
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


class DamagedEntryError(Exception):
    """Sealed bytes are not valid; the message continues after the file's name."""


class _Sealed(msgspec.Struct, frozen=True, array_like=True):
    journal: str
    entry: JournalEntry


_DECODE: Final = codecs.decoder(_Sealed)


def seal(journal: str, entry: JournalEntry) -> bytes:
    """Return an entry as it is stored by the journal with the id `journal`: marked, and with its checksum.

    Raises:
        JournalError: out of memory.
    """
    try:
        body = codecs.encode(_Sealed(journal, entry))
    except MemoryError as error:
        raise JournalError(
            f"the {len(entry.data)} bytes of {entry.kind} {entry.key} cannot be written: {error}"
        ) from None
    return _MAGIC + sha256(body) + body


def unseal(journal: str, sealed: bytes) -> JournalEntry:
    """Return a stored entry.

    Args:
        journal: id of the journal that must have stored it; empty: any.
        sealed: what was read.

    Raises:
        DamagedEntryError: the bytes are torn, damaged, or another journal's.
    """
    if not sealed.startswith(_MAGIC):
        raise DamagedEntryError("is not a file of a journal" if sealed else "is empty")
    head = len(_MAGIC) + _DIGEST_BYTES
    body = sealed[head:]
    if sha256(body) != sealed[len(_MAGIC) : head]:
        raise DamagedEntryError(f"is torn or damaged ({len(sealed)} bytes, wrong checksum)")
    try:
        contents = _DECODE(body)
    except MALFORMED as error:
        raise DamagedEntryError(f"cannot be understood ({why_malformed(error)})") from None
    if journal and contents.journal != journal:
        raise DamagedEntryError(f"belongs to the journal {contents.journal}, this is {journal}")
    return contents.entry


FORMAT: Final = 1
"""The format of a journal: a later version of Pancakes with another format has a higher number, and reads this one."""
SUFFIX: Final = ".rec"
"""The suffix of stored entries."""
BAD: Final = ".bad"
"""The suffix of entries that were set aside."""
MOST_NAMES: Final = 8
"""How many names of agents a journal remembers, the newest ones."""
_BAD_NAME: Final = re.compile(rf"(.+{re.escape(SUFFIX)})(?:\.(\d+))?{re.escape(BAD)}")
_IDENTITY: Final = "identity"
_LONGEST_NAME: Final = 200


class DiskUse(NamedTuple):
    """The disk use of a journal since it was opened: both wear out flash.

    Attributes:
        syncs: how often it has called `fsync`.
        written_bytes: how many bytes it has written.
    """

    syncs: int = 0
    written_bytes: int = 0


class Journal(ABC):
    """The durable entries of one agent.

    A new journal gets a new id (`uuid`). Another id under the same agent's name means that the disk was lost. All
    methods wait for the disk and are called in one thread at a time.

    Attributes:
        uuid: the journal's id.
        boot: how often it was opened, this time included.
        life: drawn at each opening: two journals with the same boot and different lives are copies of one.
        copy: which copy of the journal this is, if it was copied file by file, as backups and moves to another disk do;
            empty: the original. A copy of the whole disk counts as the original.
        copied: whether this opening is the first of that copy.
        former: the names of the agents that have opened it before, other than the one that does now.
        set_aside: entries that were not valid at opening; to be reported by name.
        missing: entries that were set aside at this opening or an earlier one, and not replaced since then.
        written_by: the version of Pancakes that opened it last before; empty: it is new, or the version is unknown.
        place: where it is stored, for people.
        remarks: what people should know about the place, each a sentence.
        check_s: how often, in seconds, `check` should be called; None: never.
        use: its disk use so far.
    """

    uuid: str
    boot: int
    life: str
    copy: str
    copied: bool
    former: tuple[str, ...]
    set_aside: tuple[SetAside, ...]
    missing: tuple[SetAside, ...]
    written_by: str
    place: str
    remarks: tuple[str, ...] = ()
    check_s: float | None = None
    use: DiskUse = DiskUse()

    def entries(self, kind: str) -> list[JournalEntry]:
        """Return all entries of a kind, in the order of their keys."""
        return [entry for (has, _), entry in sorted(self._entries.items()) if has == kind]

    def read(self, kind: str, key: str) -> JournalEntry | None:
        """Return one entry, or None if there is none."""
        return self._entries.get((kind, key))

    def write(self, batch: Sequence[JournalEntry]) -> None:
        """Make entries durable, at little more than the cost of a single one.

        When it returns, they are on disk. When it raises, or when the machine dies meanwhile, each of them is either
        wholly stored or not at all.

        Raises:
            JournalError: the disk is full, gone, or read-only; or an entry's kind is not valid.
            JournalLostError: see `check`.
        """
        newest: dict[str, JournalEntry] = {}
        for entry in batch:
            if not re.fullmatch(r"[a-z]+", entry.kind) or entry.kind == _IDENTITY:
                raise JournalError(f"{entry.kind!r} is not a kind of journal entry: use lower-case letters")
            newest[name_of(entry.kind, entry.key)] = entry
        self._store(newest)
        self._entries.update(((entry.kind, entry.key), entry) for entry in newest.values())

    def check(self) -> None:
        """Check that the journal is still the one that was opened.

        Raises:
            JournalLostError: it is not; the message says what has happened.
        """
        return

    @abstractmethod
    def close(self) -> None:
        """Release the journal, so that another process may open it. A second call does nothing."""

    def _store(self, newest: Mapping[str, JournalEntry]) -> None:
        """Make entries durable, by the names under which they are stored."""
        self._replace({name: seal(self.uuid, entry) for name, entry in newest.items()})

    def _open(self, new_uuid: Callable[[], str], agent: str, doubt: str = "") -> None:
        """Read all entries, set aside those that are not valid, and count the boot.

        Args:
            new_uuid: makes the id of a new journal.
            agent: the name of the agent that opens it.
            doubt: why it may not be the journal that it claims to be; empty: it is.

        Raises:
            JournalError: a later version of Pancakes wrote it, in another format. It was not changed.
        """
        self._entries: dict[tuple[str, str], JournalEntry] = {}
        aside: list[SetAside] = []
        names = self._names(SUFFIX)
        identity = name_of(_IDENTITY, _IDENTITY)
        self.life, found = new_uuid(), _JournalIdentity()
        if identity in names:
            try:
                if doubt:
                    raise DamagedEntryError(doubt)
                found = _read_identity(self._load(identity))
            except DamagedEntryError as error:
                aside.append(self._put_aside(identity, str(error)))
        if found.format > FORMAT:
            raise JournalError(
                f"{self.place} is of the format {found.format}, which Pancakes {found.version} has written, and this is"
                f" Pancakes {__version__}, which reads formats up to {FORMAT}: start it with that version"
            )
        self.written_by = found.version
        # Without an identity, the entries belong to another journal, and are set aside.
        self.uuid, mark = found.uuid or self.life, self._mark()
        self.copied = bool(found.uuid) and found.mark != mark
        # A copy of a copy is above it in order.
        self.copy = f"{found.boot + 1:08d}{self.life}" if self.copied else found.copy
        for name in names:
            if name == identity:
                continue
            try:
                entry = unseal(self.uuid, self._load(name))
                if name_of(entry.kind, entry.key) != name:
                    raise DamagedEntryError(f"has the entry {entry.kind} {entry.key}, which is not what its name says")
            except DamagedEntryError as error:
                aside.append(self._put_aside(name, str(error)))
            else:
                self._entries[entry.kind, entry.key] = entry
        self.set_aside = tuple(aside)
        self.missing = self._missing()
        self.boot = found.boot + 1
        self.former = tuple(name for name in found.agents if name != agent)
        names_now = ((*self.former, agent) if agent else self.former)[-MOST_NAMES:]
        now = _JournalIdentity(self.uuid, self.boot, names_now, mark, self.copy, FORMAT, __version__)
        contents = codecs.encode_small(now)
        self._replace({identity: seal(self.uuid, JournalEntry(_IDENTITY, _IDENTITY, contents))})

    def _is_of(self, journal: str) -> bool:
        """Return whether the stored identity is that of the journal with this id."""
        name = name_of(_IDENTITY, _IDENTITY)
        try:
            return name in self._names(SUFFIX) and bool(unseal(journal, self._load(name)))
        except DamagedEntryError:
            return False

    def _put_aside(self, name: str, reason: str) -> SetAside:
        kind, key = _parts_of(name)
        taken = self._names(BAD)
        numbered = (f"{name}.{number}{BAD}" for number in count(2))
        bad = next(bad for bad in chain((name + BAD,), numbered) if bad not in taken)
        self._rename(name, bad)
        return SetAside(self._place(name), self._place(bad), reason, kind, key)

    def _missing(self) -> tuple[SetAside, ...]:
        """Return the entries set aside that were not replaced; of several with one name, the newest."""
        newest: dict[str, tuple[int, str]] = {}
        for bad in self._names(BAD):
            match = _BAD_NAME.fullmatch(bad)
            if match:
                name, number = match[1], int(match[2] or 1)
                newest[name] = max(newest.get(name, (0, "")), (number, bad))
        missing: list[SetAside] = []
        for name, (times, bad) in sorted(newest.items()):
            kind, key = _parts_of(name)
            if (kind, key) in self._entries or kind == _IDENTITY:
                continue
            sealed = self._load(bad)
            try:
                unseal(self.uuid, sealed)
                reason = "is not what its name says"
            except DamagedEntryError as error:
                reason = str(error)
            entry = _readable(sealed, name)
            missing.append(SetAside(self._place(name), self._place(bad), reason, kind, key, entry, times))
        return tuple(missing)

    @abstractmethod
    def _mark(self) -> str:
        """Return a mark of the place that never changes, and that a copy of the place does not have."""

    @abstractmethod
    def _names(self, ending: str) -> list[str]:
        """Return all stored names that end with `ending`, sorted."""

    @abstractmethod
    def _place(self, name: str) -> str:
        """Return where `name` is stored, for people."""

    @abstractmethod
    def _load(self, name: str) -> bytes:
        """Return what is stored under `name`."""

    @abstractmethod
    def _replace(self, contents: dict[str, bytes]) -> None:
        """Store each value under its name for good, each atomically."""

    @abstractmethod
    def _rename(self, name: str, new: str) -> None:
        """Rename the entry `name`; the new name is free."""


class _JournalIdentity(NamedTuple):
    uuid: str = ""
    boot: int = 0
    agents: tuple[str, ...] = ()
    mark: str = ""
    copy: str = ""
    format: int = 1
    version: str = ""


_DECODE_LIST: Final = codecs.decoder(list[Any])
_DECODE_IDENTITY: Final = codecs.decoder(_JournalIdentity)


def _read_identity(sealed: bytes) -> _JournalIdentity:
    entry = unseal("", sealed)
    try:
        known = _DECODE_LIST(entry.data)[: len(_JournalIdentity._fields)]  # a later version may have more fields
        return _DECODE_IDENTITY(codecs.encode_small(known))
    except MALFORMED as error:
        raise DamagedEntryError(f"cannot be understood ({why_malformed(error)})") from None


def _readable(sealed: bytes, name: str) -> JournalEntry | None:
    try:
        entry = unseal("", sealed)
    except DamagedEntryError:
        return None
    return entry if name_of(entry.kind, entry.key) == name else None


def name_of(kind: str, key: str) -> str:
    """Return the name under which an entry is stored.

    Raises:
        JournalError: it would be too long.
    """
    name = f"{kind}.{quote(key, safe='')}"
    if len(name) > _LONGEST_NAME:
        raise JournalError(f"the key {key!r} is too long for a journal entry: {len(name)} of {_LONGEST_NAME} letters")
    return name + SUFFIX


def _parts_of(name: str) -> tuple[str, str]:
    kind, dot, key = name.removesuffix(SUFFIX).partition(".")
    return (kind, unquote(key)) if dot else ("", "")


MARK: Final = "mark"
"""The key for the mark of a disk in memory; leave it out to simulate a copy that was made file by file."""


class MemoryJournal(Journal):
    """A journal on a dictionary: it survives its agent if the caller keeps the dictionary.

    Args:
        disk: the stored bytes, by name; an empty one is a new disk.
        new_uuid: the id of a new journal; in virtual time it comes from the seed.
        agent: the name of the agent that opens it.

    Attributes:
        fault: why writes fail; empty: they work.
        latency_s: the duration of a write in virtual time.
    """

    place = "memory"
    fault: str = ""
    latency_s: float = 0.002

    def __init__(self, disk: dict[str, bytes], new_uuid: str, agent: str = "") -> None:
        self._disk = disk
        if "lock" in disk:
            raise JournalError("the journal is in use already: two agents cannot share one")
        disk["lock"] = b""
        self._closed = False
        self._open(lambda: new_uuid, agent)

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._disk.pop("lock", None)

    def _mark(self) -> str:
        return self._disk.setdefault(MARK, self.life.encode()).decode()

    def _names(self, ending: str) -> list[str]:
        return sorted(name for name in self._disk if name.endswith(ending))

    def _place(self, name: str) -> str:
        return name

    def _load(self, name: str) -> bytes:
        return self._disk[name]

    def _replace(self, contents: dict[str, bytes]) -> None:
        if self._closed:
            raise JournalError("the journal is closed")
        if self.fault:
            raise JournalError(self.fault)
        self._disk.update(contents)

    def _rename(self, name: str, new: str) -> None:
        self._disk[new] = self._disk.pop(name)
