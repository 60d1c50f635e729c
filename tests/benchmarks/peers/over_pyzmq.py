"""Two processes with pyzmq: a DEALER in each, which blocks when its queue is full.

python over_pyzmq.py far
python over_pyzmq.py near ADDRESS
"""

from __future__ import annotations

import sys
import time

import zmq
from talk import body_of, encode, hear, kind_of, say, unpack


def far() -> None:
    """Answers pings, and acknowledges the last of what comes one way."""
    dealer = zmq.Context().socket(zmq.DEALER)
    dealer.bind("tcp://127.0.0.1:*")
    say(at=dealer.getsockopt(zmq.LAST_ENDPOINT).decode().rstrip("\0"), version=zmq.__version__)
    count = 0
    while True:
        packet = unpack(dealer.recv())
        kind, body = kind_of(packet), body_of(packet)
        if kind == "ping":
            count = 0
            dealer.send(encode("pong", body["number"], body["data"]))
        else:
            count += 1
            if body["number"] < 0:
                dealer.send(encode("got", count, b""))


def near(address: str) -> None:
    """Measures round trips, then packets one way."""
    dealer = zmq.Context().socket(zmq.DEALER)
    dealer.connect(address)
    plan = hear()
    data = bytes(plan["size"])
    times_s = []
    for number in range(plan["round_trips"]):
        asked_s = time.perf_counter()
        dealer.send(encode("ping", number, data))
        unpack(dealer.recv())
        times_s.append(time.perf_counter() - asked_s)
    packets = plan["packets"]
    began_s = time.perf_counter()
    for number in range(packets):
        dealer.send(encode("load", number if number + 1 < packets else -1, data))
    count = body_of(unpack(dealer.recv()))["number"]
    say(times_s=times_s, per_s=packets / (time.perf_counter() - began_s), received=count)
    hear()


if __name__ == "__main__":
    if sys.argv[1] == "far":
        far()
    else:
        near(sys.argv[2])
