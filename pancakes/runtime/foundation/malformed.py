"""Bytes from outside that are not what they should be: what decoding them may raise, and how that reads."""

from __future__ import annotations

from typing import Final

import msgspec

MALFORMED: Final = (msgspec.DecodeError, RecursionError, UnicodeError)
"""All that msgspec's decoders raise. `RecursionError`: they are nested thousands deep."""


def why_malformed(error: Exception) -> str:
    """Returns what is wrong with the bytes, to stand in a sentence behind what they should have been."""
    return "it is nested too deep" if isinstance(error, RecursionError) else str(error)
