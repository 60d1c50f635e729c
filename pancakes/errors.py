"""Everything that Pancakes raises on purpose, and how an error reads that nobody foresaw (`describe`).

Each message is a sentence that names what is at fault (file, key, peer, packet), because the command
line prints it as it stands: a traceback in a user's terminal is a defect.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple


class PancakesError(Exception):
    """The base of all errors that Pancakes raises on purpose."""


class Fault(NamedTuple):
    """One mistake in a configuration.

    Attributes:
        where: the file, with a line number where it is known (`agent1.toml:12`), or `--set`.
        key: the table and key, such as `[task.ScanTarget] restart`.
        problem: what is wrong, as a phrase.
        suggestion: what was probably meant, or an empty string.
    """

    where: str
    key: str
    problem: str
    suggestion: str = ""

    def __str__(self) -> str:
        hint = f", did you mean {self.suggestion!r}?" if self.suggestion else ""
        return f"{self.where}: {self.key}: {self.problem}{hint}"


class ConfigError(PancakesError):
    """A configuration cannot be used. Carries all of its faults at once."""

    def __init__(self, faults: Sequence[Fault]) -> None:
        self.faults = tuple(faults)
        super().__init__("\n".join(str(fault) for fault in self.faults))


class PluginError(PancakesError):
    """An entry point is missing or fails to load. The message names the distribution."""


class ClassError(PancakesError, TypeError):
    """A task, service or driver is written in a way that cannot work. The message has the file and line of each fault,
    and what to write instead. Raised when the class is made."""


class WireError(PancakesError):
    """Bytes or packets break the wire protocol."""


class LocalProtocolError(WireError):
    """We were about to send what the protocol forbids (a body too large, an unknown type of value)."""


class RemoteProtocolError(WireError):
    """The peer sent what the protocol forbids. Its link is closed; nothing else is touched."""


class UnknownChannel(PancakesError):
    """A packet was published to a channel that the information stream does not have."""


class MailboxFull(PancakesError):
    """A `reliable` subscriber has no room: the packet was given to nobody, the publisher may try again."""


class ControlRefused(PancakesError):
    """A control packet was understood and refused. The message is the reason."""


class Unreachable(PancakesError):
    """An agent that was asked for something did not answer."""


class NoAnswer(Unreachable):
    """An agent was asked for something, and whether it does it is not known."""


class MigrationError(PancakesError):
    """A task could not be moved. It goes on where it is."""


class NoCandidate(MigrationError):
    """No neighbour can take the task. The message has each neighbour's reason."""


class PeerLost(MigrationError):
    """The peer went away before the hand-off was decided."""


def describe(error: BaseException) -> str:
    """Returns an error as a sentence with the place that raised it, without a traceback."""
    text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    place = error.__traceback__
    while place is not None and place.tb_next is not None:
        place = place.tb_next
    if place is None:
        return text
    code = place.tb_frame.f_code
    return f"{text} ({code.co_filename.rpartition('/')[2]}:{place.tb_lineno}, in {code.co_name})"
