"""JPEG images for tests: real headers, and no picture worth looking at."""

from __future__ import annotations


def jpeg(width: int, height: int, extra: int = 0) -> bytes:
    """Return an image whose header tells this size, with a comment that makes it larger."""
    comments = b""
    while extra > 0:
        part = min(extra, 60_000)
        comments += b"\xff\xfe" + (part + 2).to_bytes(2, "big") + bytes(part)
        extra -= part
    app0 = b"\xff\xe0\x00\x10JFIF\x00\x01\x01\x00\x00\x01\x00\x01\x00\x00"
    sof = b"\xff\xc0\x00\x0b\x08" + height.to_bytes(2, "big") + width.to_bytes(2, "big") + b"\x01\x01\x11\x00"
    return b"\xff\xd8" + app0 + comments + sof + b"\xff\xda\x00\x08\x01\x01\x00\x00\x3f\x00\xd2\xff\xd9"
