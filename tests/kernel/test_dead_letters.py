"""Packets that were in hand when a component failed: what is remembered of them has a bound."""

from __future__ import annotations

from kernel.actors import bounded

from pancakes.kernel.dead_letters import ATTEMPTS, MOST_KNOWN, DeadLetters
from pancakes.kernel.handlers import reliable
from pancakes.kernel.mailbox import Mailbox
from pancakes.packet import SYSTEM, Packet


def test_packets_that_fail_and_never_come_again_are_forgotten_and_the_newest_are_not():
    buried = []
    letters = DeadLetters(lambda level, text: buried.append(text))
    mailbox = Mailbox()
    queue = bounded(mailbox, SYSTEM, {"some": reliable(4)}).of("some")
    packets = [Packet(SYSTEM, "some", "a/client/Source", "", 0.0, number, None) for number in range(MOST_KNOWN + 1)]
    for packet in packets:
        letters.failed("a/client/Sink", queue, packet)
        mailbox.take()  # its reader ended before the packet came again
    for _ in range(ATTEMPTS - 1):
        letters.failed("a/client/Sink", queue, packets[0])  # was forgotten: begins anew
        letters.failed("a/client/Sink", queue, packets[-1])
    assert len(buried) == 1 and f"#{MOST_KNOWN} from a/client/Source" in buried[0]
