"""A connection over a socket that knows what is at its other end."""

from __future__ import annotations

from pancakes.mesh.net.stream_connection import StreamConnection
from pancakes.mesh.net.tls_layer import TlsLayer


class TlsConnection(TlsLayer, StreamConnection):
    """One encrypted connection over a socket; see `TlsLayer` for what it takes."""
