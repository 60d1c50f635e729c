"""What an agent trusts of its peers: certificates and rosters over links, new keys, and what peers may send.

`Trust` decides by the access rules what a peer may send. It distributes the signed roster: an agent that knows a higher
number gives it to one that has a lower one. The signature is checked in a separate process, so that no running agent
imports `cryptography`. It takes a new key while the agent runs, and renews its links one after the other.
"""

from __future__ import annotations

import importlib.util
import sys
import threading
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, NamedTuple

from pancakes.errors import PancakesError
from pancakes.mesh.admission import Bucket
from pancakes.mesh.links import Links
from pancakes.mesh.messages import Hello, Refusal, RosterNumber, RosterText
from pancakes.mesh.session import Session
from pancakes.mesh.transport import Scheduled
from pancakes.packet import Packet
from pancakes.security.access import Access, asks, fault_of_source
from pancakes.security.roster import FALSE, UNKEPT, Bearer, Roster, fault_of_bearer, read_signed

if TYPE_CHECKING:
    from pancakes.security.keys import Keys


LOOK_S: Final = 60.0
"""How often the number is sent to peers again, and their certificates are checked for their end."""
CHECK_S: Final = 30.0
"""How long the check of a signature may take."""
MOST_CHECKS: Final = 4
"""At most this many rosters are checked at a time, one of each peer."""

UNCHECKED: Final = "a roster cannot be checked without cryptography: pip install 'pancakes-agents[keys]'"


class RosterFault(NamedTuple):
    """Why an agent does not use a roster, or cannot keep it.

    Attributes:
        number: the number of the roster; 0: the fault holds for every roster.
        text: why, as a sentence.
    """

    number: int
    text: str


KEY_RELOAD_S: Final = 60.0
"""How often the agent looks for a new key."""
PAUSE_S: Final = 1.0
"""The pause between two links that are renewed, so that an agent never loses all of them at once."""
MOST_ASKED_HZ: Final = 1000.0
"""How many requests a peer may send in a second, and at once. Further ones are refused."""


class Trust:
    """The keys, the roster and the rules of one agent, as its links need them. In the transport's thread.

    Args:
        role: the role of this agent.
        keys: its keys; None: it has none, and peers show no certificates.
        access: the rights of its peers; None: it is a terminal, which takes packets of any source on any channel.
        links: its links.
        tell: sends a message over a link.
        refuse: ends a link, with the reason for the peer.
        call_later: as `Transport.call_later`.
        now: the host clock.
        log: takes (level, text).

    Attributes:
        roster_fault: why the last roster from a peer was not taken or not kept; None: no fault.
    """

    def __init__(
        self,
        role: str,
        keys: Keys | None,
        access: Access | None,
        links: Links,
        tell: Callable[[Session, RosterNumber | RosterText], None],
        refuse: Callable[[Session, Refusal, str], None],
        call_later: Callable[[float, Callable[[], None]], Scheduled],
        now: Callable[[], float],
        log: Callable[[str, str], None],
    ) -> None:
        self._role = role
        self._keys = keys
        self._access = access
        self._links = links
        self._tell = tell
        self._refuse = refuse
        self._call_later = call_later
        self._now = now
        self._log = log
        self._checking: set[str] = set()  # the peers whose rosters are being checked
        self._unkept = False  # the roster in force is not on disk yet
        self._old_links: deque[Session] = deque()  # links that must be made again with a new key
        self.roster_fault: RosterFault | None = None
        if access is not None:
            access.bearer_of = self._bearer_of

    def begin(self) -> None:
        """Begin, when the mesh begins."""
        if self._keys is not None:
            if not can_check():
                self.roster_fault = RosterFault(0, UNCHECKED)
            self._call_later(LOOK_S, self._look_at_roster)
            self._call_later(KEY_RELOAD_S, self._look_for_key)

    def on_link_up(self, session: Session) -> None:
        """Tell a new peer which roster is known here."""
        if self._keys is not None and self._keys.roster is not None:
            self._tell(session, RosterNumber(self._keys.roster.number))

    # What peers may send

    def fault_of_hello(self, session: Session, hello: Hello) -> str:
        """Return how a hello differs from the certificate of its sender, as a sentence; empty: not at all."""
        shown = session.certified
        return fault_of_bearer(shown, hello.name, hello.role, hello.fleet) if shown is not None else ""

    def fault_of_packet(self, session: Session, packet: Packet) -> str:
        """Return why the peer may not send packets with this head, as a sentence; empty: it may."""
        access = self._access
        if access is None:
            return ""
        return fault_of_source(self._role, session.peer, session.role, packet) or access.fault_of_packet(
            *_bearer(session), session.peer, packet
        )

    def asks_too_much(self, session: Session, first: Packet, number: int) -> str:
        """Return why the peer's requests are refused, as a sentence; empty: none, or not too many.

        Args:
            session: the link that the packets came over.
            first: the first of them; the others have the same head.
            number: how many they are.
        """
        if self._access is None or not asks(first) or self._asked_of(session).take(number, self._now()):
            return ""
        return f"{session.peer} sends more than {MOST_ASKED_HZ:g} requests in a second"

    def _asked_of(self, session: Session) -> Bucket:
        if session.asked is None:
            session.asked = Bucket(MOST_ASKED_HZ, MOST_ASKED_HZ, self._now())
        return session.asked

    def _bearer_of(self, peer: str) -> tuple[Bearer, bool] | None:
        """See `Access.bearer_of`. Any thread."""
        session = self._links.by_name().get(peer)
        return _bearer(session) if session is not None else None

    # The roster

    def on_roster(self, session: Session, message: RosterNumber | RosterText) -> None:
        """Take the number of a peer's roster, or the roster."""
        keys = self._keys
        if keys is None:
            return
        own = keys.roster.number if keys.roster is not None else 0
        if isinstance(message, RosterText):
            self._check_roster(keys, session, message.text)
        elif message.number > own:
            self._tell(session, RosterNumber(own))
        elif message.number < own:
            self._tell(session, RosterText(keys.roster_text))

    def _check_roster(self, keys: Keys, session: Session, text: bytes) -> None:
        """Check the signature of a roster, in a separate process."""
        try:
            _, roster = read_signed(text)
        except ValueError as error:
            self._refuse(session, "name", f"the roster that it gave cannot be read: {error}")
            return
        if keys.roster is not None and roster.number <= keys.roster.number:
            return  # another peer was faster
        if fault := keys.fault_of_roster(roster):
            self._not_taken(session, roster, fault)
            return
        if session.peer in self._checking or len(self._checking) >= MOST_CHECKS:
            return  # the peer will get our number again, and send the roster again
        self._checking.add(session.peer)

        def check() -> None:
            fault, code = keep(keys, text)
            self._call_later(0.0, lambda: self._checked(keys, session, roster, text, fault, code))

        threading.Thread(target=check, name="roster", daemon=True).start()

    def _not_taken(self, session: Session, roster: Roster, fault: str) -> None:
        self._log("warning", f"{session.peer} gave a roster that is not taken: {fault}")
        self.roster_fault = RosterFault(roster.number, fault)

    def _checked(self, keys: Keys, session: Session, roster: Roster, text: bytes, fault: str, code: int) -> None:
        self._checking.discard(session.peer)
        if code == FALSE:
            self._log("warning", f"{session.peer} gave a roster that is not taken: {fault}")
            self._refuse(session, "name", fault)
        elif code not in (0, UNKEPT):
            self._not_taken(session, roster, fault)
        elif keys.learn(roster, text):
            # A full disk must not keep a revoked peer connected: the roster applies now, and is written later.
            self._unkept = code == UNKEPT
            self.roster_fault = RosterFault(roster.number, fault) if fault else None
            if fault:
                self._log("error", f"{fault}. This agent goes by it until it ends")
            revoked = len(roster.revoked)
            self._log("info", f"{session.peer} gave the roster {roster.number} of {roster.fleet}: {revoked} revoked")
            if own := keys.fault_of(keys.own):
                self._log("error", f"no agent of {roster.fleet} believes this one any more: {own}")
            self._end_those_revoked(keys)
            self._tell_all()

    def _look_at_roster(self) -> None:
        if self._keys is not None:
            self._end_those_revoked(self._keys)
            self._tell_all()
            if self._unkept:
                self._keep_again(self._keys)
            self._call_later(LOOK_S, self._look_at_roster)

    def _keep_again(self, keys: Keys) -> None:
        """Try again to write the present roster to disk."""
        text = keys.roster_text

        def again() -> None:
            _, code = keep(keys, text)
            self._call_later(0.0, lambda: self._kept(keys, text, code))

        threading.Thread(target=again, name="roster", daemon=True).start()

    def _kept(self, keys: Keys, text: bytes, code: int) -> None:
        if code == 0 and text == keys.roster_text:
            self._unkept, self.roster_fault = False, None

    def _tell_all(self) -> None:
        for session in self._links:
            self.on_link_up(session)

    def _end_those_revoked(self, keys: Keys) -> None:
        for session in self._links:
            if session.certified is not None and (fault := keys.fault_of(session.certified)):
                self._refuse(session, "name", f"{session.peer} is not believed any more: {fault}")

    # A new key

    def reload_keys(self, dry_run: bool = False) -> bool:
        """Take the key that is on disk now; return whether it is a new one. Any thread.

        Args:
            dry_run: only check whether there is a new one.

        Raises:
            PancakesError: it cannot be used, or there are no keys.
        """
        if self._keys is None:
            raise PancakesError("it has no keys: pancakes keys join, and start it again")
        is_new = self._keys.reload(dry_run)
        if dry_run or not is_new:
            return is_new
        self._log("info", f"there is a new key in {self._keys.folder}, and links are renewed with it")
        self._call_later(0.0, self._renew_links)
        return True

    def _look_for_key(self) -> None:
        try:
            self.reload_keys()
        except PancakesError as error:
            self._log("warning", str(error))
        self._call_later(KEY_RELOAD_S, self._look_for_key)

    def _renew_links(self) -> None:
        runs = bool(self._old_links)
        self._old_links = deque(session for session in self._links if session.certified is not None)
        if not runs:
            self._renew_next()

    def _renew_next(self) -> None:
        if self._old_links:
            # Both sides dial again at once after a link that ends as a duplicate.
            self._refuse(self._old_links.popleft(), "duplicate", "there is a new key, and links are renewed")
            self._call_later(PAUSE_S, self._renew_next)


def can_check() -> bool:
    """Return whether the library that checks signatures of rosters is installed."""
    try:
        return importlib.util.find_spec("cryptography") is not None
    except (ImportError, ValueError):
        return False


def keep(keys: Keys, text: bytes) -> tuple[str, int]:
    """Check the signature of a roster, and keep it with the keys. Waits for a process: call it in a thread.

    Returns:
        What is wrong, as a sentence (empty: nothing, it is kept), and the exit code of `check_roster`.
    """
    import subprocess

    command = [sys.executable, "-m", "pancakes.security.check_roster", str(keys.folder)]
    try:
        ended = subprocess.run(command, input=text, capture_output=True, timeout=CHECK_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"its signature cannot be checked: {error}", 1
    if ended.returncode == 0:
        return "", 0
    said = ended.stderr.decode(errors="replace").strip().splitlines()
    return said[-1] if said else f"its check ended with {ended.returncode}", ended.returncode


def _bearer(session: Session) -> tuple[Bearer, bool]:
    shown = session.certified
    if shown is not None:
        return Bearer(shown.name, shown.role, shown.groups), True
    return Bearer(session.peer, "operator" if session.role == "client" else session.role), False
