"""The journal: durable entries, an id for life, and a counter of boots. Storage is a subclass's matter."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from itertools import chain, count
from typing import Any, Final, NamedTuple
from urllib.parse import quote, unquote

from pancakes import __version__
from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.malformed import MALFORMED, why_malformed
from pancakes.runtime.journal.seal import JournalEntry, JournalError, SetAside, Unbelievable, seal, unseal

FORMAT: Final = 1
"""Of what a journal keeps: a later version of Pancakes that keeps it otherwise has a higher one, and reads this."""
SUFFIX: Final = ".rec"
"""What names of stored entries end with."""
BAD: Final = ".bad"
"""What is appended to the name of what was set aside."""
MOST_NAMES: Final = 8
"""So many names of agents a journal remembers, the newest."""
_BAD_NAME: Final = re.compile(rf"(.+{re.escape(SUFFIX)})(?:\.(\d+))?{re.escape(BAD)}")
_IDENTITY: Final = "identity"
_LONGEST_NAME: Final = 200


class DiskUse(NamedTuple):
    """What a journal has asked of its disk since it was opened: flash wears out by both.

    Attributes:
        syncs: how often it has waited until all was on the disk (`fsync`).
        written_bytes: how much it has written.
    """

    syncs: int = 0
    written_bytes: int = 0


class Journal(ABC):
    """The durable entries of one agent.

    Its id (`uuid`) is made with it; a journal with another id under the same agent's name means that the
    disk was lost. All methods wait for the disk and are called in one thread at a time.

    Attributes:
        uuid: the journal's id.
        boot: how often it was opened, this time included.
        life: drawn anew at each opening: two that have the same boot and another life are copies of one journal.
        copy: which copy of the journal this is, where a file at a time was copied, as backups and moves to another
            disk do; empty: the original. A copy of the whole disk is taken for what it is a copy of.
        copied: whether this opening is the first of that copy.
        former: the names of the agents that have opened it before, other than the one that does now.
        set_aside: what was found at opening and could not be believed; to be reported by name.
        missing: what was set aside at this opening or an earlier one, and has no entry in its place since then.
        written_by: the version of Pancakes that opened it last before; empty: it is new, or that was not written down.
        place: where it is kept, for people.
        remarks: what people should know about that place, each a sentence.
        check_s: how often, in seconds, `check` should be called; None: there is nothing to check.
        use: what it has asked of the disk so far.
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
        """Returns all entries of a kind, in the order of their keys."""
        return [entry for (has, _), entry in sorted(self._entries.items()) if has == kind]

    def read(self, kind: str, key: str) -> JournalEntry | None:
        """Returns one entry, or None where there is none."""
        return self._entries.get((kind, key))

    def write(self, batch: Sequence[JournalEntry]) -> None:
        """Makes entries durable, all of them at the price of little more than one.

        When it returns they are on disk for good. When it raises, or when the machine dies in it, each of
        them is either wholly there or not at all.

        Raises:
            JournalError: the disk is full, gone, or read-only; or an entry's kind is no word.
            JournalLost: see `check`.
        """
        newest: dict[str, JournalEntry] = {}
        for entry in batch:
            if not re.fullmatch(r"[a-z]+", entry.kind) or entry.kind == _IDENTITY:
                raise JournalError(f"{entry.kind!r} is no kind of journal entry: lower-case letters are")
            newest[name_of(entry.kind, entry.key)] = entry
        self._store(newest)
        self._entries.update(((entry.kind, entry.key), entry) for entry in newest.values())

    def check(self) -> None:
        """Looks whether the journal still is what was opened.

        Raises:
            JournalLost: it is not; the message says what has happened.
        """
        return

    @abstractmethod
    def close(self) -> None:
        """Lets go of the journal, so that another process may open it. A second call does nothing."""

    def _store(self, newest: Mapping[str, JournalEntry]) -> None:
        """Makes entries durable, by the names under which each is stored."""
        self._replace({name: seal(self.uuid, entry) for name, entry in newest.items()})

    def _open(self, new_uuid: Callable[[], str], agent: str, doubt: str = "") -> None:
        """Reads everything there is, puts aside what cannot be believed, and counts the boot.

        Args:
            new_uuid: makes the id of a new journal.
            agent: the name of the agent that opens it.
            doubt: why this is not believed to be the journal that it says it is; empty: it is.

        Raises:
            JournalError: a later version of Pancakes has written it, in another format. Nothing of it was changed.
        """
        self._entries: dict[tuple[str, str], JournalEntry] = {}
        aside: list[SetAside] = []
        names = self._names(SUFFIX)
        identity = name_of(_IDENTITY, _IDENTITY)
        self.life, found = new_uuid(), _JournalIdentity()
        if identity in names:
            try:
                if doubt:
                    raise Unbelievable(doubt)
                found = _read_identity(self._load(identity))
            except Unbelievable as error:
                aside.append(self._put_aside(identity, str(error)))
        if found.format > FORMAT:
            raise JournalError(
                f"{self.place} is of the format {found.format}, which Pancakes {found.version} has written, and this is"
                f" Pancakes {__version__}, which reads formats up to {FORMAT}: start it with that version"
            )
        self.written_by = found.version
        # Without an identity of its own, entries that are there belong to another journal, and are put aside.
        self.uuid, mark = found.uuid or self.life, self._mark()
        self.copied = bool(found.uuid) and found.mark != mark
        self.copy = self.life if self.copied else found.copy
        for name in names:
            if name == identity:
                continue
            try:
                entry = unseal(self.uuid, self._load(name))
                if name_of(entry.kind, entry.key) != name:
                    raise Unbelievable(f"has the entry {entry.kind} {entry.key}, which is not what its name says")
            except Unbelievable as error:
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
        """Returns whether the identity that is stored is that of the journal with this id."""
        name = name_of(_IDENTITY, _IDENTITY)
        try:
            return name in self._names(SUFFIX) and bool(unseal(journal, self._load(name)))
        except Unbelievable:
            return False

    def _put_aside(self, name: str, reason: str) -> SetAside:
        kind, key = _parts_of(name)
        taken = self._names(BAD)
        numbered = (f"{name}.{number}{BAD}" for number in count(2))
        bad = next(bad for bad in chain((name + BAD,), numbered) if bad not in taken)
        self._rename(name, bad)
        return SetAside(self._place(name), self._place(bad), reason, kind, key)

    def _missing(self) -> tuple[SetAside, ...]:
        """Returns what lies aside and has no entry in its place; of several of one name the newest."""
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
            except Unbelievable as error:
                reason = str(error)
            entry = _readable(sealed, name)
            missing.append(SetAside(self._place(name), self._place(bad), reason, kind, key, entry, times))
        return tuple(missing)

    @abstractmethod
    def _mark(self) -> str:
        """Returns what a copy of the place does not have in common with it, and what it keeps for life."""

    @abstractmethod
    def _names(self, ending: str) -> list[str]:
        """Returns the names of all that is stored and ends with `ending`, sorted."""

    @abstractmethod
    def _place(self, name: str) -> str:
        """Returns where `name` lies, for people."""

    @abstractmethod
    def _load(self, name: str) -> bytes:
        """Returns what is stored under `name`."""

    @abstractmethod
    def _replace(self, contents: dict[str, bytes]) -> None:
        """Stores each value under its name for good, each atomically."""

    @abstractmethod
    def _rename(self, name: str, new: str) -> None:
        """Gives what lies at `name` another name, which is free."""


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
        known = _DECODE_LIST(entry.data)[: len(_JournalIdentity._fields)]  # a later version may have more to say
        return _DECODE_IDENTITY(codecs.encode_small(known))
    except MALFORMED as error:
        raise Unbelievable(f"cannot be understood ({why_malformed(error)})") from None


def _readable(sealed: bytes, name: str) -> JournalEntry | None:
    try:
        entry = unseal("", sealed)
    except Unbelievable:
        return None
    return entry if name_of(entry.kind, entry.key) == name else None


def name_of(kind: str, key: str) -> str:
    """Returns the name under which an entry is stored.

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
