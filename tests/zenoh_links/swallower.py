"""A program that takes all links through a router, and reads all that comes.

python swallower.py ROUTER ADDRESS [SILENT_S]
"""

import sys
import threading

from pancakes.mesh.transport import Connection, ConnectionHandler, SocketTransport
from pancakes.util.clock import MonotonicClock
from pancakes.util.plugins import Plugins


class Swallower(ConnectionHandler):
    def opened(self, connection: Connection) -> None:
        self.connection = connection

    def received(self, data: bytes) -> None:
        pass

    def closed(self, reason: str) -> None:
        pass


if __name__ == "__main__":
    settings = {"zenoh": {"insecure": True, "routers": [sys.argv[1]], "silent_s": float((*sys.argv, "2")[3])}}
    transport = SocketTransport(MonotonicClock(), "swallower", Plugins(), settings)
    print(transport.listen(sys.argv[2], Swallower), flush=True)
    threading.Event().wait()
