"""The recordings that an agent was asked for, kept on disk: they go on when the agent was killed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import msgspec

from pancakes.runtime.foundation import codecs
from pancakes.runtime.journal import Disk, RecordTable

KIND = "recording"


class WantedRecording(msgspec.Struct, frozen=True):
    """A recording that is to go on.

    Attributes:
        first: the path of its first file; empty: nothing is to be recorded.
        settings: the recorder's settings, as plain values.
    """

    first: str = ""
    settings: Mapping[str, Any] = msgspec.field(default_factory=dict)


NOTHING: Final = WantedRecording()
"""Nothing is to be recorded."""


def wanted_recordings(disk: Disk) -> RecordTable[WantedRecording]:
    """Returns which recordings are to go on, by the path of the recorder (`log/Recorder`)."""

    def malformed(path: str, why: str) -> None:
        disk.unread.append(f"the journal does not say any more which recording is to go on: {why}")

    return RecordTable(disk, KIND, codecs.decoder(WantedRecording), malformed)
