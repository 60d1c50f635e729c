"""Commands to an actuator, for the tests of reports."""

from pancakes.devices import Twist
from pancakes.packet import Packet
from pancakes.recording.causal_chains import ActuatorCommand, Chain, ChainStep

MS = 1_000_000


def command(number, latency_ms=2.0, agent="a", source="client/Scan"):
    """The command number `number`, ten a second."""
    at_ns = number * 100 * MS
    read = Packet("system", "pose", f"{agent}/device/pose", "", at_ns / 1e9, number + 1, None)
    given = Packet("ctrl", "motors", f"{agent}/{source}", "", at_ns / 1e9, number + 1, Twist(0.1, 0.0))
    took_ns = round(latency_ms * MS)
    steps = (ChainStep(read, at_ns, 0.0005, latency_ms / 1e3 - 0.0005), ChainStep(given, at_ns + took_ns, 0.0, 0.0))
    return ActuatorCommand(at_ns + took_ns, given, Chain(steps))
