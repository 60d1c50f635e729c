"""Decide who may open a page that is served beyond the loopback interface: those who know its password. Pure.

A browser sends the password once, in a header that no other site can set, and gets a cookie that is valid for
`SIGNED_IN_S`. The cookie is an expiry and its signature, so it outlives a restart of the server, and ends with the
password. Wrong passwords are limited for each address and for all together, so that nobody can guess.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import re
from base64 import b64decode
from collections import OrderedDict, deque
from collections.abc import Collection, Sequence
from typing import Final

SHORTEST: Final = 8
"""The shortest password, in characters."""
LONGEST: Final = 512
SIGNED_IN_S: Final = 12 * 3600
"""How long a cookie is valid, in seconds."""
WINDOW_S: Final = 60.0
"""The time in which wrong passwords are counted, in seconds."""
MOST_WRONG: Final = 5
"""The most wrong passwords from one address in that time."""
MOST_WRONG_OF_ALL: Final = 60
"""The most wrong passwords from all addresses in that time."""
MOST_ADDRESSES: Final = 1000
"""The most addresses whose wrong passwords are counted; beyond that the oldest is forgotten."""
HEADER: Final = "X-Page-Password"


class SignIn:
    """Check passwords and cookies. Times are of the host's clock, those of cookies seconds since 1970.

    Args:
        password: the password.
        secret: signs cookies; the same after a restart, so that cookies stay valid.
        cookie: the name of the cookie.
    """

    def __init__(self, password: str, secret: str, cookie: str) -> None:
        self.cookie = cookie
        self._digest = hashlib.sha256(password.encode()).digest()
        self._key = hmac.digest(secret.encode(), self._digest, "sha256")
        self._wrong: OrderedDict[str, deque[float]] = OrderedDict()
        self._wrong_of_all: deque[float] = deque()

    @property
    def addresses(self) -> int:
        """How many addresses have sent a wrong password not long ago."""
        return len(self._wrong)

    def pause_s(self, address: str, now_s: float) -> float:
        """Return how long an address must wait before it may try another password; 0: it may now."""
        self._forget(now_s)
        pauses = [
            wrong[0] + WINDOW_S - now_s
            for wrong, most in (
                (self._wrong.get(_network(address), deque()), MOST_WRONG),
                (self._wrong_of_all, MOST_WRONG_OF_ALL),
            )
            if len(wrong) >= most
        ]
        return max(pauses, default=0.0)

    def is_right(self, header: str, address: str, now_s: float) -> bool:
        """Return whether a header has the password, and count a wrong one. Ask `pause_s` first."""
        if hmac.compare_digest(hashlib.sha256(_decoded(header)).digest(), self._digest):
            self._wrong.pop(_network(address), None)
            return True
        wrong = self._wrong.setdefault(_network(address), deque(maxlen=MOST_WRONG))
        self._wrong.move_to_end(_network(address))
        wrong.append(now_s)
        self._wrong_of_all.append(now_s)
        if len(self._wrong) > MOST_ADDRESSES:
            self._wrong.popitem(last=False)
        return False

    def _forget(self, now_s: float) -> None:
        while self._wrong_of_all and now_s - self._wrong_of_all[0] >= WINDOW_S:
            self._wrong_of_all.popleft()
        while self._wrong and now_s - next(iter(self._wrong.values()))[-1] >= WINDOW_S:
            self._wrong.popitem(last=False)
        for wrong in self._wrong.values():
            while wrong and now_s - wrong[0] >= WINDOW_S:
                wrong.popleft()

    def new_cookie(self, wall_s: float, secure: bool) -> str:
        """Return the header `Set-Cookie` for a browser that knows the password."""
        expires = int(wall_s) + SIGNED_IN_S
        return self._header(f"{expires}.{self._signature(expires)}", SIGNED_IN_S, secure)

    def no_cookie(self, secure: bool) -> str:
        """Return the header `Set-Cookie` that makes a browser forget the cookie."""
        return self._header("", 0, secure)

    def _header(self, value: str, age_s: int, secure: bool) -> str:
        only = "; Secure" if secure else ""
        return f"{self.cookie}={value}; Max-Age={age_s}; Path=/; HttpOnly; SameSite=Strict{only}"

    def knows(self, cookies: Sequence[str], wall_s: float) -> bool:
        """Return whether one of the `Cookie` headers has a valid cookie."""
        for part in ";".join(cookies).split(";"):
            name, _, value = part.strip().partition("=")
            found = re.fullmatch(r"(\d{1,12})\.([0-9a-f]{64})", value) if name == self.cookie else None
            if found is None:
                continue
            expires = int(found[1])
            if hmac.compare_digest(found[2], self._signature(expires)) and wall_s < expires:
                return True
        return False

    def _signature(self, expires: int) -> str:
        return hmac.new(self._key, str(expires).encode(), "sha256").hexdigest()


def _decoded(header: str) -> bytes:
    """Return the password in a header, which is Base64 of UTF-8; something that no password is if it is malformed."""
    try:
        return b64decode(header[: 2 * LONGEST], validate=True)
    except ValueError:
        return b""


def _network(address: str) -> str:
    """Return what counts as one address: one IPv4 address, or the 64 bits of IPv6 that one machine is given."""
    try:
        ip = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(ip, ipaddress.IPv6Address):
        return str(ip.ipv4_mapped or ipaddress.IPv6Network((int(ip) >> 64 << 64, 64)))
    return str(ip)


def fault_of_password(password: str) -> str:
    """Return why a password cannot be used; empty if it can."""
    if len(password) < SHORTEST:
        return f"the password of a page has at least {SHORTEST} characters, this one has {len(password)}"
    if len(password.encode()) > LONGEST:
        return f"the password of a page has at most {LONGEST} bytes"
    return ""


_HOST: Final = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(?::\d{1,5})?")


def is_own_name(hosts: Sequence[str], names: Collection[str]) -> bool:
    """Return whether a request has exactly one `Host` header, with an IP address or one of the server's names.

    A site that leads its own name to this machine (DNS rebinding) sends that name. It cannot send an address: the
    browser sends what stands in its address bar.

    Args:
        hosts: the headers.
        names: the names of the server, in lower case.
    """
    found = _HOST.fullmatch(hosts[0]) if len(hosts) == 1 else None
    if found is None:
        return False
    name = found[1].lower().rstrip(".")
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return name in names
    return True
