"""A program that plays the hardware of a tiny node, on a pseudo-terminal or over UDP.

    python -m pancakes_sensor_field.tiny_node --node 7 --pty /tmp/shed
    python -m pancakes_sensor_field.tiny_node --node 9 --udp 127.0.0.1:7421 --period 2

The readings of its sensors come on standard input, a line for each change: `t 21.5` is a temperature in degrees
Celsius, `m 1` means that something moves, `m 0` that nothing does. It prints when its siren begins and ends. It ends
with its standard input, and so with the program at the other end, however that ends. It imports nothing of Pancakes.
"""

from __future__ import annotations

import argparse
import os
import random
import select
import signal
import socket
import sys
import time
import tty
from contextlib import suppress
from pathlib import Path

from pancakes_sensor_field.mote import Mote, spoilt


class PtyWire:
    """A pseudo-terminal; a link leads to the end that others open, like `/dev/ttyUSB0`."""

    def __init__(self, link: str) -> None:
        self._link = Path(link)
        # The far end stays open here too, so others can open and close it without ending this one.
        self.file, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self.file, False)
        self._link.unlink(missing_ok=True)
        self._link.symlink_to(os.ttyname(self._far))

    def send(self, data: bytes) -> None:
        with suppress(BlockingIOError):  # no program reads at the far end: as on a wire, it is lost
            os.write(self.file, data)

    def receive(self) -> bytes:
        return os.read(self.file, 256)

    def close(self) -> None:
        self._link.unlink(missing_ok=True)


class UdpWire:
    """A socket that sends to one address."""

    def __init__(self, address: str) -> None:
        host, _, port = address.rpartition(":")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((host, int(port)))
        self._socket.setblocking(False)
        self.file = self._socket.fileno()

    def send(self, data: bytes) -> None:
        with suppress(OSError):  # no program listens there
            self._socket.send(data)

    def receive(self) -> bytes:
        try:
            return self._socket.recv(256)
        except OSError:
            return b""

    def close(self) -> None:
        self._socket.close()


def run(mote: Mote, wire: PtyWire | UdpWire, speed: float, garble: float) -> None:
    """Play a tiny node until its standard input ends."""
    noise = random.Random(1)
    celsius, moving, typed, sounds = None, False, b"", False

    def send(data: bytes) -> None:
        if data and noise.random() < garble:
            data = spoilt(data)
        if data:
            wire.send(data)

    send(mote.start(time.monotonic() * speed))
    while True:
        now_s = time.monotonic() * speed
        ready, _, _ = select.select([0, wire.file], [], [], max(0.0, mote.next_s - now_s) / speed)
        now_s = time.monotonic() * speed
        if wire.file in ready:
            send(mote.received(wire.receive(), now_s))
        if 0 in ready:
            heard = os.read(0, 4096)
            if not heard:
                return
            *lines, typed = (typed + heard).split(b"\n")
            for line in lines:
                what, _, value = line.partition(b" ")
                if what == b"t":
                    celsius = float(value)
                elif what == b"m":
                    moving = value.strip() == b"1"
                if celsius is not None:
                    send(mote.sense(celsius, moving))
        send(mote.tick(now_s))
        if mote.sounds != sounds:
            sounds = mote.sounds
            print("the siren sounds" if sounds else "the siren is silent", flush=True)


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(prog="tiny_node", description="Plays the hardware of a tiny sensor node.")
    parser.add_argument("--node", type=int, required=True, help="its number, 1 to 254")
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--pty", metavar="LINK", help="open a pseudo-terminal, and let LINK lead to its far end")
    where.add_argument("--udp", metavar="HOST:PORT", help="send datagrams there")
    parser.add_argument("--period", type=float, default=10.0, help="seconds between reports at first")
    parser.add_argument("--speed", type=float, default=1.0, help="seconds of its own for each real one")
    parser.add_argument("--garble", type=float, default=0.0, help="share of what it sends that is spoilt on the wire")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(0))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's Ctrl-C is for the program that started this one
    wire = PtyWire(arguments.pty) if arguments.pty else UdpWire(arguments.udp)
    print(f"the tiny node {arguments.node} speaks at {arguments.pty or arguments.udp}", flush=True)
    try:
        run(Mote(arguments.node, arguments.period), wire, arguments.speed, arguments.garble)
    finally:
        wire.close()


if __name__ == "__main__":
    main()
