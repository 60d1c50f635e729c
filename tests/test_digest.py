"""The digest is SHA-256, for short and for long data."""

import hashlib

import pytest

from pancakes.util.codecs import LONG_BYTES, sha256


@pytest.mark.parametrize("length", [0, 300, LONG_BYTES - 1, LONG_BYTES, 3 * LONG_BYTES])
def test_it_is_that_of_hashlib(length: int):
    data = bytes(range(256)) * (length // 256) + bytes(length % 256)

    assert sha256(data) == hashlib.sha256(data).digest()
