"""Cuts what a process prints into lines."""

from __future__ import annotations

from codecs import getincrementaldecoder
from collections.abc import Iterator
from typing import Final

LONGEST: Final = 65_536
"""A line that has no end is cut after so many characters."""


class Lines:
    """The lines of one process. What is no UTF-8 is shown as replacement characters."""

    def __init__(self) -> None:
        self._decoder = getincrementaldecoder("utf-8")("replace")
        self._begun = ""

    def feed(self, data: bytes) -> Iterator[str]:
        """Takes what was printed, and yields the lines that are whole by that."""
        *whole, self._begun = (self._begun + self._decoder.decode(data)).split("\n")
        for line in whole:
            yield line.removesuffix("\r")
        while len(self._begun) > LONGEST:
            yield self._begun[:LONGEST]
            self._begun = self._begun[LONGEST:]

    def rest(self) -> Iterator[str]:
        """Yields the last line, where it has no end."""
        begun, self._begun = self._begun + self._decoder.decode(b"", final=True), ""
        if begun:
            yield begun
