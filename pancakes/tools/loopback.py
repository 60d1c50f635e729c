"""Decide which requests a server on the loopback interface answers: only those under a name of that interface.

The header `Host` has the name that a browser used. If that is a foreign name, the name server of a foreign site has
pointed it at this machine, and the site could read the answer (DNS rebinding).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

_NAMES: Final = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?", re.IGNORECASE)


def names_loopback(hosts: Sequence[str]) -> bool:
    """Return whether a request has exactly one `Host` header, with a name of the loopback interface."""
    return len(hosts) == 1 and _NAMES.fullmatch(hosts[0]) is not None
