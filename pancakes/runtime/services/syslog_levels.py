"""The level of each line for the journal of systemd, where standard error leads there."""

from __future__ import annotations

import os
from functools import cache
from typing import Final

_PRIORITIES: Final = {"debug": 7, "info": 6, "warning": 4, "error": 3}
_STANDARD_ERROR: Final = 2


@cache
def leads_to_journal() -> bool:
    """Returns whether standard error leads to the journal, which says so in `JOURNAL_STREAM`."""
    try:
        status = os.fstat(_STANDARD_ERROR)
    except OSError:
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


def for_standard_error(text: str, level: str) -> str:
    """Returns text as it is, or each of its lines behind its level as the journal reads it, such as `<4>`."""
    if not leads_to_journal():
        return text
    return "\n".join(f"<{_PRIORITIES.get(level, 6)}>{line}" for line in text.split("\n"))
