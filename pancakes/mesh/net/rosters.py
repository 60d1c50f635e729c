"""How rosters travel: an agent that knows a higher number gives it to one that has a lower one."""

from __future__ import annotations

import importlib.util
import sys
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, NamedTuple

from pancakes.mesh.net.links import Links
from pancakes.mesh.net.session import Session
from pancakes.mesh.net.transport import Scheduled
from pancakes.mesh.security.roster import FALSE, UNKEPT, Roster, read_signed
from pancakes.mesh.wire.link_messages import Refusal, RosterNumber, RosterText

if TYPE_CHECKING:
    from pancakes.mesh.security.keys import Keys

LOOK_S: Final = 60.0
"""So often the peers are told the number again, and looked at whether their certificates have ended."""
CHECK_S: Final = 30.0
"""So long the check of a signature may take."""
MOST_CHECKS: Final = 4
"""So many rosters are checked at a time; of each peer one."""

UNCHECKED: Final = "a roster cannot be checked without cryptography: pip install 'pancakes-agents[keys]'"


class RosterFault(NamedTuple):
    """Why an agent does not go by a roster, or cannot keep it.

    Attributes:
        number: the number of the roster; 0: the same is true of each that will come.
        text: why, as a sentence.
    """

    number: int
    text: str


LookAgain = Callable[[float, Callable[[], None]], Scheduled]


class Rosters:
    """The roster that an agent knows, and the peers that it tells of it. In the transport's thread.

    Args:
        keys: the agent's keys; None: it has none, and none of this happens.
        links: its links.
        tell: sends a message over a link.
        refuse: ends a link, for a reason that the peer is told.
        call_later: as `Transport.call_later`.
        log: takes (level, text).

    Attributes:
        fault: why the roster that was given last is not taken, or is not kept; None: all is well.
    """

    def __init__(
        self,
        keys: Keys | None,
        links: Links,
        tell: Callable[[Session, RosterNumber | RosterText], None],
        refuse: Callable[[Session, Refusal, str], None],
        call_later: LookAgain,
        log: Callable[[str, str], None],
    ) -> None:
        self._keys = keys
        self._links = links
        self._tell = tell
        self._refuse = refuse
        self._call_later = call_later
        self._log = log
        self._checking: set[str] = set()
        self._unkept = False
        self.fault: RosterFault | None = None

    def begin(self) -> None:
        """The mesh has begun."""
        if self._keys is not None:
            if not can_check():
                self.fault = RosterFault(0, UNCHECKED)
            self._call_later(LOOK_S, self._look)

    def stood_up(self, session: Session) -> None:
        """A link stands."""
        if self._keys is not None and self._keys.roster is not None:
            self._tell(session, RosterNumber(self._keys.roster.number))

    def heard(self, session: Session, message: RosterNumber | RosterText) -> None:
        """A peer tells its number, or gives its roster."""
        keys = self._keys
        if keys is None:
            return
        own = keys.roster.number if keys.roster is not None else 0
        if isinstance(message, RosterText):
            self._check(keys, session, message.text)
        elif message.number > own:
            self._tell(session, RosterNumber(own))
        elif message.number < own:
            self._tell(session, RosterText(keys.roster_text))

    def _check(self, keys: Keys, session: Session, text: bytes) -> None:
        """Has the signature of a roster checked, in a process of its own."""
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
            return  # it is told the number again, and gives the roster again
        self._checking.add(session.peer)

        def check() -> None:
            fault, code = keep(keys, text)
            self._call_later(0.0, lambda: self._checked(keys, session, roster, text, fault, code))

        threading.Thread(target=check, name="roster", daemon=True).start()

    def _not_taken(self, session: Session, roster: Roster, fault: str) -> None:
        self._log("warning", f"{session.peer} gave a roster that is not taken: {fault}")
        self.fault = RosterFault(roster.number, fault)

    def _checked(self, keys: Keys, session: Session, roster: Roster, text: bytes, fault: str, code: int) -> None:
        self._checking.discard(session.peer)
        if code == FALSE:
            self._log("warning", f"{session.peer} gave a roster that is not taken: {fault}")
            self._refuse(session, "name", fault)
        elif code not in (0, UNKEPT):
            self._not_taken(session, roster, fault)
        elif keys.learn(roster, text):
            # A disk that is full must not let a revoked peer stay: it is obeyed now, and written later.
            self._unkept = code == UNKEPT
            self.fault = RosterFault(roster.number, fault) if fault else None
            if fault:
                self._log("error", f"{fault}. This agent goes by it until it ends")
            revoked = len(roster.revoked)
            self._log("info", f"{session.peer} gave the roster {roster.number} of {roster.fleet}: {revoked} revoked")
            if own := keys.fault_of(keys.own):
                self._log("error", f"no agent of {roster.fleet} believes this one any more: {own}")
            self._end_those_revoked(keys)
            self._tell_all()

    def _look(self) -> None:
        if self._keys is not None:
            self._end_those_revoked(self._keys)
            self._tell_all()
            if self._unkept:
                self._keep_again(self._keys)
            self._call_later(LOOK_S, self._look)

    def _keep_again(self, keys: Keys) -> None:
        """Tries again to write down the roster that this agent goes by."""
        text = keys.roster_text

        def again() -> None:
            _, code = keep(keys, text)
            self._call_later(0.0, lambda: self._kept(keys, text, code))

        threading.Thread(target=again, name="roster", daemon=True).start()

    def _kept(self, keys: Keys, text: bytes, code: int) -> None:
        if code == 0 and text == keys.roster_text:
            self._unkept, self.fault = False, None

    def _tell_all(self) -> None:
        for session in self._links:
            self.stood_up(session)

    def _end_those_revoked(self, keys: Keys) -> None:
        for session in self._links:
            if session.certified is not None and (fault := keys.fault_of(session.certified)):
                self._refuse(session, "name", f"{session.peer} is not believed any more: {fault}")


def can_check() -> bool:
    """Returns whether the library is installed that checks the signature of a roster."""
    try:
        return importlib.util.find_spec("cryptography") is not None
    except (ImportError, ValueError):
        return False


def keep(keys: Keys, text: bytes) -> tuple[str, int]:
    """Checks the signature of a roster, and keeps it beside the keys. Waits for a process, in a thread of its own.

    Returns:
        What is wrong, as a sentence (empty: nothing, it is kept), and the exit code of `check_roster`.
    """
    import subprocess

    command = [sys.executable, "-m", "pancakes.mesh.security.check_roster", str(keys.folder)]
    try:
        ended = subprocess.run(command, input=text, capture_output=True, timeout=CHECK_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"its signature cannot be checked: {error}", 1
    if ended.returncode == 0:
        return "", 0
    said = ended.stderr.decode(errors="replace").strip().splitlines()
    return said[-1] if said else f"its check ended with {ended.returncode}", ended.returncode
