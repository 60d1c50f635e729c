"""Two processes with pyzmq: a DEALER in each, which blocks when its queue is full.

python over_pyzmq.py far
python over_pyzmq.py near ADDRESS
"""

from __future__ import annotations

import sys

import zmq
from talk import answering, hear, measure, say, unpack


def far() -> None:
    """Answers pings, and acknowledges the last of what comes one way."""
    dealer = zmq.Context().socket(zmq.DEALER)
    dealer.bind("tcp://127.0.0.1:*")
    say(at=dealer.getsockopt(zmq.LAST_ENDPOINT).decode().rstrip("\0"), version=zmq.__version__)
    take = answering(dealer.send)
    while True:
        take(dealer.recv())


def near(address: str) -> None:
    """Measures round trips, then packets one way."""
    dealer = zmq.Context().socket(zmq.DEALER)
    dealer.connect(address)
    measure(hear(), dealer.send, dealer.send, lambda: unpack(dealer.recv()))


if __name__ == "__main__":
    if sys.argv[1] == "far":
        far()
    else:
        near(sys.argv[2])
