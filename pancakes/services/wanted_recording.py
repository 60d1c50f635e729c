"""The recording that somebody has asked an agent for, kept on disk: it goes on when the agent was killed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import msgspec

from pancakes import codecs
from pancakes.journal import Journal, JournalEntry, RecordStore
from pancakes.malformed import MALFORMED, why_malformed

KIND = "recording"


class Wanted(msgspec.Struct, frozen=True):
    """A recording that is to go on.

    Attributes:
        first: the path of its first file; empty: nothing is to be recorded.
        settings: the recorder's settings, as plain values.
    """

    first: str = ""
    settings: Mapping[str, Any] = msgspec.field(default_factory=dict)


_DECODE = codecs.decoder(Wanted)


class WantedRecording:
    """Remembers which recording is wanted. In one thread, but for the callbacks.

    Args:
        journal: read once, here.
        store: what writes to that journal.
        service: the Log Service whose recorder it is.

    Attributes:
        unread: what the journal has and could not be read, each a sentence.
        now: what is wanted, on disk or about to be; None: nothing.
        on_disk: what is wanted as the disk knows it.
    """

    def __init__(self, journal: Journal, store: RecordStore, service: str = "log") -> None:
        self._store = store
        self._key = f"{service}/Recorder"
        self.unread: list[str] = []
        self.now: Wanted | None = None
        entry = journal.read(KIND, self._key)
        if entry is not None:
            try:
                found = _DECODE(entry.data)
                self.now = found if found.first else None
            except MALFORMED as error:
                self.unread.append(
                    f"the journal does not say any more which recording is to go on: {why_malformed(error)}"
                )
        self.on_disk = self.now

    def want(self, wanted: Wanted | None, then: Callable[[], None], failed: Callable[[str], None]) -> None:
        """Begins to write down what is wanted from now on. Never waits.

        Args:
            wanted: the recording that is to go on; None: nothing is.
            then: called, in the store's thread, when it is on disk for good.
            failed: called instead, with the reason, where it could not be written.
        """
        self.now = wanted

        def written() -> None:
            self.on_disk = wanted
            then()

        self._store.persist(JournalEntry(KIND, self._key, codecs.encode_small(wanted or Wanted())), written, failed)
