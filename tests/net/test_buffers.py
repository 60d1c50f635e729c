"""How much the kernels may hold of what is on its way."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from pancakes.mesh.sockets import NOT_SENT_BYTES, RECEIVE_BYTES, bound_buffers

pytestmark = pytest.mark.skipif(not hasattr(socket, "TCP_NOTSENT_LOWAT"), reason="this system has no such bounds")


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        near = socket.create_connection(listener.getsockname())
        far, _ = listener.accept()
        with near, far:
            yield near, far


def taken(near: socket.socket) -> int:
    """Sends as much as both kernels take of it while the other end does not read."""
    near.setblocking(False)
    total = 0
    try:
        while True:
            total += near.send(bytes(16 * 1024))
    except BlockingIOError:
        return total


def test_of_what_nobody_reads_the_kernels_hold_little(pair):
    near, far = pair
    bound_buffers(near)
    bound_buffers(far)
    assert taken(near) <= 4 * (NOT_SENT_BYTES + RECEIVE_BYTES)


def test_without_bounds_they_hold_much_more(pair):
    near, _ = pair
    assert taken(near) > 4 * (NOT_SENT_BYTES + RECEIVE_BYTES)


def test_a_socket_that_is_gone_is_left_alone(pair):
    near, _ = pair
    near.close()
    bound_buffers(near)
