"""Which requests a server on the loopback interface answers: those under a name of that interface.

A browser says in the header `Host` which name led it there. Where a foreign name does, a foreign site's name server has
pointed at this machine, and the site would read what it is given (DNS rebinding).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

_NAMES: Final = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?", re.IGNORECASE)


def names_loopback(hosts: Sequence[str]) -> bool:
    """Return whether the values of a request's `Host` headers are one, and a name of the loopback interface."""
    return len(hosts) == 1 and _NAMES.fullmatch(hosts[0]) is not None
