"""Runs in the virtual machine, as its root: carries out the commands that come on a port, one after the other."""

from __future__ import annotations

import json
import subprocess

PORT = "/dev/virtio-ports/commands"


def main() -> None:
    """Never ends."""
    with open(PORT, "r+b", buffering=0) as port:
        waiting = b""
        while True:
            *lines, waiting = (waiting + port.read(65536)).split(b"\n")
            for line in lines:
                done = subprocess.run(
                    ["sh", "-c", json.loads(line)],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                )
                port.write(json.dumps([done.returncode, done.stdout]).encode() + b"\n")


if __name__ == "__main__":
    main()
