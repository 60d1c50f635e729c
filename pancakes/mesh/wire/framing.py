"""How messages are cut out of a stream of bytes.

A frame is a 4-byte big-endian length and that many bytes of msgpack: an array of one or more messages.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final

from pancakes.errors import LocalProtocolError, RemoteProtocolError

MAX_PAYLOAD_BYTES: Final = 256 * 1024
"""Longest payload of a frame."""
MAX_MESSAGE_BYTES: Final = MAX_PAYLOAD_BYTES - 5
"""Longest message that still fits a frame, behind the header of the frame's array."""

_LENGTH = struct.Struct(">I")


def frame(messages: Sequence[bytes]) -> bytes:
    """Returns encoded messages as one or more frames, as few as the limits allow.

    Raises:
        LocalProtocolError: a message does not fit a frame.
    """
    if len(messages) == 1 and len(messages[0]) <= MAX_MESSAGE_BYTES:  # most frames of a dialogue
        return _LENGTH.pack(len(messages[0]) + 1) + b"\x91" + messages[0]
    parts: list[bytes] = []
    start = length = 0
    for index, message in enumerate(messages):
        if len(message) > MAX_MESSAGE_BYTES:
            raise LocalProtocolError(f"a message of {len(message)} bytes does not fit a frame ({MAX_MESSAGE_BYTES})")
        if length + len(message) > MAX_MESSAGE_BYTES or index - start == 65_535:
            _one_frame(messages[start:index], length, parts)
            start, length = index, 0
        length += len(message)
    if start < len(messages):
        _one_frame(messages[start:], length, parts)
    return b"".join(parts)


def array_head(count: int) -> bytes:
    """Returns what a msgpack array of up to 65,535 items begins with."""
    return bytes((0x90 | count,)) if count < 16 else b"\xdc" + count.to_bytes(2, "big")


def _one_frame(messages: Sequence[bytes], length: int, parts: list[bytes]) -> None:
    header = array_head(len(messages))
    parts.append(_LENGTH.pack(len(header) + length))
    parts.append(header)
    parts.extend(messages)


class FrameReader:
    """Cuts payloads out of the bytes of one connection, however the network cut those."""

    def __init__(self) -> None:
        self._rest = b""
        self._missing = 0  # bytes without which `_rest` has no whole frame
        self._chunks: list[bytes] = []

    def feed(self, data: bytes) -> list[memoryview]:
        """Takes bytes that came in.

        Returns:
            The payloads that are now complete, in order: views of what was joined anyway, not copied once more.

        Raises:
            RemoteProtocolError: a length of 0 or above the limit was announced. Nothing was kept for it; the
                reader is of no more use.
        """
        if not self._rest and len(data) > 4 and _LENGTH.unpack_from(data)[0] == len(data) - 4 <= MAX_PAYLOAD_BYTES:
            return [memoryview(data)[4:]]  # one whole frame, as most that come
        if self._missing > len(data):  # a long frame arrives in many pieces: join them once, not each time
            self._chunks.append(data)
            self._missing -= len(data)
            return []
        if self._chunks or self._rest:
            data = b"".join((self._rest, *self._chunks, data))
            self._chunks.clear()
        payloads: list[memoryview] = []
        position, end = 0, len(data)
        view = memoryview(data)
        self._missing = 0
        while end - position >= 4:
            (length,) = _LENGTH.unpack_from(data, position)
            if not 1 <= length <= MAX_PAYLOAD_BYTES:
                raise RemoteProtocolError(f"a frame of {length} bytes was announced; 1 to {MAX_PAYLOAD_BYTES} may be")
            if end - position - 4 < length:
                self._missing = length - (end - position - 4)
                break
            payloads.append(view[position + 4 : position + 4 + length])
            position += 4 + length
        self._rest = data[position:]
        return payloads
