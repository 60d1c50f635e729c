"""Letters to a task over a network that loses, doubles and reorders them."""

import random

from pancakes.durable.delivery import ForwardTo, Incoming, Outgoing, Receipt, Seek, name_to
from pancakes.durable.record import TaskId

SCAN = TaskId("a", "Scan")
STREAM = "me/1#secret"
NAME = name_to(STREAM, "a/Scan")


def post_over_a_bad_network(seed):
    """Check that each letter has its effect once and in order over a network that loses, doubles and reorders.

    The receiver moves, with its filter; and at times it goes back to a checkpoint of all that it acknowledged.
    """
    source = random.Random(seed)
    out, filter_ = Outgoing(STREAM, "me"), Incoming()
    effects: list[int] = []
    checkpoint: tuple[list[int], dict[str, int]] = ([], {})
    host, epoch_n, posted, now_s = "a", 0, 0, 0.0
    wire = []

    def lose_and_double(dispatches):
        for dispatch in dispatches:
            wire.extend([dispatch] * source.choice([0, 1, 1, 2]))

    while posted < 300 or out.waiting():
        now_s += 0.02
        assert now_s < 2000.0
        if posted < 300 and source.random() < 0.5:
            posted += 1
            lose_and_double(out.post(SCAN, str(posted).encode(), "a", now_s))
        lose_and_double(out.due(now_s))
        if source.random() < 0.03:
            host, epoch_n = source.choice("abc"), epoch_n + 1
        if source.random() < 0.02:
            effects, filter_ = list(checkpoint[0]), Incoming(checkpoint[1])
        for _ in range(min(len(wire), source.randrange(6))):
            dispatch = wire.pop(source.randrange(len(wire)) if source.random() < 0.3 else 0)
            if isinstance(dispatch, Seek):
                lose_and_double(out.forwarded(ForwardTo("a/Scan", host, epoch_n), host, now_s))
                continue
            letter, peer = dispatch.letter, dispatch.peer
            if peer != host:
                lose_and_double(out.forwarded(ForwardTo("a/Scan", host, epoch_n), peer, now_s))
                continue
            if filter_.is_next(letter.stream, letter.seq, letter.first):
                effects.append(int(letter.packet))
                filter_.took(letter.stream, letter.seq)
            elif not filter_.is_old(letter.stream, letter.seq):
                continue
            if source.random() < 0.5:  # the acknowledgement follows the checkpoint, and may be lost
                checkpoint = list(effects), filter_.heard()
                if source.random() < 0.8:
                    lose_and_double(out.acknowledged(Receipt("a/Scan", NAME, len(effects), epoch_n), host, now_s))
    assert effects == list(range(1, 301))
