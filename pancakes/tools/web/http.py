"""What the page's server answers over HTTP: a file, or a sentence why not."""

from __future__ import annotations

from http import HTTPStatus
from typing import Final

from websockets.datastructures import Headers
from websockets.http11 import Response

_HEADERS: Final = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; connect-src 'self' ws:;"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


def response(status: HTTPStatus, type_: str, data: bytes) -> Response:
    """Returns an answer with a body of this type, after which the connection is closed."""
    headers = Headers({**_HEADERS, "Content-Type": type_, "Content-Length": str(len(data)), "Connection": "close"})
    return Response(status.value, status.phrase, headers, data)


def refused(status: HTTPStatus, sentence: str) -> Response:
    """Returns the answer to a request that gets nothing but a sentence."""
    return response(status, "text/plain; charset=utf-8", f"{sentence}\n".encode())
