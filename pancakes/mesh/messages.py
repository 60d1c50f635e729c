"""The messages of a link besides packets: hello, welcome, ping, gossip, rosters, clocks. Pure.

On the wire each message is an array that begins with its number. The number 0 is a run of packets
(`pancakes.mesh.codec.PacketRun`). `VERSION` is the version of the protocol; agents of different versions do not talk.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Final, Literal

import msgspec

from pancakes.errors import LocalProtocolError
from pancakes.mesh.address import DEFAULT_FLEET, parse_address
from pancakes.util import codecs
from pancakes.util.text import fault_of_name
from pancakes.util.timebase import Moment, Timebase

VERSION: Final = 13
"""Version of the wire protocol. Agents of different versions do not talk."""

HELLO_NUMBER: Final = 1
"""First element of a `Hello`; the version follows it in every version of the protocol, past and to come."""

Role = Literal["agent", "environment", "client"]
"""`agent` may host tasks; `environment` is a simulated world, and never does; `client` is a terminal, not an agent."""

Refusal = Literal["version", "fleet", "name", "self", "old", "duplicate", "full", "protocol"]
"""Why a link was refused, for programs. A sentence for people goes with it.

`version`, `fleet`: different from ours. `name`: another agent has it. `self`: we dialled ourselves. `old`: a later boot
of that agent is connected. `duplicate`: another connection to that agent stays. `full`: no room for more peers.
`protocol`: the peer broke the protocol.
"""

MOST_LISTEN: Final = 8
"""Most addresses at which one agent listens."""

Name = Annotated[str, msgspec.Meta(max_length=256)]
"""The name of an agent or a fleet; `fault_of_hello` checks its characters."""
Address = Annotated[str, msgspec.Meta(max_length=256)]
Sentence = Annotated[str, msgspec.Meta(max_length=1000)]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**53)]
Duration = Annotated[float, msgspec.Meta(ge=0, le=1e9)]
"""A time on a clock, in seconds."""


class Hello(msgspec.Struct, frozen=True, array_like=True, tag=HELLO_NUMBER):
    """The first message on a link, from both sides, first from the one that dialled: who the sender is.

    Attributes:
        version: version of the wire protocol.
        fleet: agents of different fleets do not talk.
        name: the agent's name, the first part of all its addresses.
        role: what it may be asked for.
        journal: UUID of its journal; it distinguishes two agents of one name.
        boot: how often that journal was opened; a higher one is a later life of the same agent.
        listen: the addresses at which the receiver can dial it, the best first.
        life: drawn at each opening of the journal: if the journal was copied, one boot has two lives.
    """

    version: int
    fleet: Name
    name: Name
    role: Role
    journal: Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
    boot: Count
    listen: Annotated[tuple[Address, ...], msgspec.Meta(max_length=MOST_LISTEN)] = ()
    life: Annotated[str, msgspec.Meta(max_length=64)] = ""


def fault_of_hello(hello: Hello) -> str:
    """Return why a hello is not valid, as a sentence; empty if it is."""
    fault = fault_of_name(hello.name, client=hello.role == "client") or fault_of_name(hello.fleet)
    return fault or next(filter(None, map(fault_of_address, hello.listen)), "")


def fault_of_address(address: str) -> str:
    """Return why a text is not an address at which an agent can listen, as a sentence; empty if it is."""
    try:
        parse_address(address)
    except ValueError:
        return f"{address!a} is no address, such as tcp://192.0.2.1:7401"
    return ""


class Welcome(msgspec.Struct, frozen=True, array_like=True, tag=2):
    """Sent by the agent with the lower name, on one connection at a time: the one that stays."""


class RefuseLink(msgspec.Struct, frozen=True, array_like=True, tag=3):
    """The last message on a link that its sender does not want."""

    code: Refusal
    reason: Sentence


class Ping(msgspec.Struct, frozen=True, array_like=True, tag=4):
    """The heartbeat; `token` counts the sender's pings."""

    token: Count


class Pong(msgspec.Struct, frozen=True, array_like=True, tag=5):
    """The answer to a ping.

    Attributes:
        at_s: when it was answered, in the sender's host time. A ping is answered the moment it comes, so this is both
            the second and the third of NTP's four times.
            the second and third of NTP's four.
    """

    token: Count
    at_s: Moment


class Goodbye(msgspec.Struct, frozen=True, array_like=True, tag=6):
    """The last message of an agent that leaves on purpose.

    Attributes:
        why: it will `sleep` (and does not count as dead), or it will `stop`; or only the link will `rest`, because it
            is surplus and not used.
        for_s: how long it sleeps, in seconds of host time; None: unknown. Of a link that rests: for how long it is not
            dialled again unless there is something to send.
    """

    why: Literal["sleep", "stop", "rest"]
    for_s: Duration | None = None


class AgentSeen(msgspec.Struct, frozen=True, array_like=True):
    """An agent that the sender of gossip knows.

    Attributes:
        name: the agent's name.
        address: where the receiver can dial it.
        age_s: how long ago it was last connected, in seconds of host time; 0: the sender is connected to it.
    """

    name: Name
    address: Address
    age_s: Duration = 0.0


class Gossip(msgspec.Struct, frozen=True, array_like=True, tag=7):
    """Gossip: agents that the sender is connected to or has heard of, never clients."""

    agents: Annotated[tuple[AgentSeen, ...], msgspec.Meta(max_length=128)]


def fault_of_gossip(gossip: Gossip) -> str:
    """Return why gossip is not valid, as a sentence; empty if it is."""
    faults = (fault_of_name(it.name) or fault_of_address(it.address) for it in gossip.agents)
    return next(filter(None, faults), "")


class RosterNumber(msgspec.Struct, frozen=True, array_like=True, tag=8):
    """The number of the sender's roster (`pancakes.security.roster`); a peer with a higher one sends its own.

    Attributes:
        number: its number; 0: none.
    """

    number: Count


class RosterText(msgspec.Struct, frozen=True, array_like=True, tag=9):
    """A roster, as its authority signed it."""

    text: Annotated[bytes, msgspec.Meta(max_length=128 * 1024)]


LinkNews = Gossip | RosterNumber | RosterText | Timebase
"""News of the fleet and of the sender, once the link is up."""

LinkMessage = Hello | Welcome | RefuseLink | Ping | Pong | Goodbye | LinkNews


class Identity(msgspec.Struct, frozen=True):
    """The identity of an agent, for its links; see `Hello` for the attributes.

    Attributes:
        copy: which copy of its journal it has; empty: the original. Not part of the hello.
    """

    name: str
    journal: str
    boot: int = 0
    fleet: str = DEFAULT_FLEET
    role: Role = "agent"
    life: str = ""
    copy: str = ""

    def hello(self, listen: Sequence[str] = ()) -> Hello:
        """Return the hello of this agent, which listens at the addresses in `listen`.

        Raises:
            LocalProtocolError: a part is not valid, such as a name with a slash.
        """
        row = [
            HELLO_NUMBER,
            VERSION,
            self.fleet,
            self.name,
            self.role,
            self.journal,
            self.boot,
            list(listen),
            self.life,
        ]
        try:
            hello = codecs.convert(row, Hello)
        except msgspec.ValidationError as error:
            raise LocalProtocolError(f"the agent {self.name!r} cannot introduce itself: {error}") from None
        if fault := fault_of_hello(hello):
            raise LocalProtocolError(f"the agent {self.name!r} cannot introduce itself: {fault}")
        return hello
