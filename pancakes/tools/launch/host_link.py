"""A connection to a host over SSH, and the program of `pancakes.tools.there` at its other end."""

from __future__ import annotations

import base64
import contextlib
import json
import math
import os
import select
import subprocess
from collections.abc import Callable, Iterator
from typing import Any, Final, TypedDict

import msgspec

from pancakes.errors import PancakesError, Unreachable
from pancakes.runtime.clock import MonotonicClock
from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.json_text import plain_of
from pancakes.tools.launch.ssh import no_ssh, open_host, scratch_file, sentence_of, silent, source

OPEN_S: Final = 30.0
"""A host that has not answered for so long cannot be reached."""
CALL_S: Final = 900.0
"""The longest that anything asked of a host takes: a slow disk unpacks wheels."""
SILENT_S: Final = 30.0
"""A host that has begun to answer says each few seconds that it lives; one that is silent for so long has gone."""
PIECE_BYTES: Final = 192 * 1024
"""Files are sent in pieces of so many bytes."""
_CHUNK: Final = 1 << 16
_NOW: Final = MonotonicClock().now


LONGEST_LINE: Final = 16 << 20
"""No answer of a host is longer."""


class _Told(TypedDict, total=False):
    """What a host says in one line: the answer to a request, or an event of an agent."""

    id: int
    result: Any
    fault: str
    agent: str
    event: str
    text: str
    code: int


class HostError(PancakesError):
    """A host cannot do what it was asked for. The sentence names it, and what to do."""


class HostLink:
    """One connection to a host, for the thread that has it. Nothing here waits but `obtain`.

    Args:
        host: the host, as `ssh` takes it.

    Attributes:
        host: the same.
        lost: a sentence about the end of the connection; empty: it has not ended.
        begun: whether the host has begun to answer.

    Raises:
        PancakesError: there is no `ssh` on this machine.
    """

    def __init__(self, host: str) -> None:
        self.host = host
        self.lost = ""
        self._errors = scratch_file()
        try:
            self._process, self._marker = open_host(host, self._errors)
        except OSError as error:
            os.close(self._errors)
            raise PancakesError(no_ssh(error)) from None
        assert self._process.stdin is not None and self._process.stdout is not None
        self._in, self._out = self._process.stdout.fileno(), self._process.stdin.fileno()
        for end in (self._in, self._out):
            os.set_blocking(end, False)
        self._waiting = bytearray(source(self._marker))
        self._line = bytearray()
        self._number = 0
        self._heard_s = _NOW()
        self._noise_bytes = 0
        self.begun = False

    @property
    def reads(self) -> int:
        """The file descriptor at which answers come."""
        return self._in

    @property
    def writes(self) -> int:
        """The file descriptor to which requests go."""
        return self._out

    @property
    def has_more(self) -> bool:
        """Whether requests wait that can be written (`flush`)."""
        return self.begun and bool(self._waiting)

    def send(self, do: str, **arguments: Any) -> int:
        """Asks for something; returns the number that its answer bears."""
        self._number += 1
        self._waiting += json.dumps({"id": self._number, "do": do, **arguments}).encode() + b"\n"
        self.flush()
        return self._number

    def flush(self) -> None:
        """Writes as much of what waits as the connection takes now; nothing before the host has begun to answer."""
        try:
            while self.has_more and not self.lost:
                del self._waiting[: os.write(self._out, self._waiting[:_CHUNK])]
        except BlockingIOError:
            pass
        except OSError:
            self._waiting.clear()  # its end is read where answers come

    def read(self) -> list[dict[str, Any]]:
        """Returns the answers and the events that have come; where the connection has ended, `lost` says why."""
        if self.lost:
            return []
        try:
            data = os.read(self._in, _CHUNK)
        except BlockingIOError:
            return []
        if not data:
            self._end()
            return []
        *lines, begun = data.split(b"\n")
        if lines:
            lines[0], self._line = bytes(self._line) + lines[0], bytearray()
        self._line += begun
        if not self.begun:
            del self._line[:-_CHUNK]  # a shell may print without an end
        try:
            if max(map(len, (*lines, self._line))) > LONGEST_LINE:
                raise ValueError(f"a line of more than {LONGEST_LINE >> 20} MiB")
            found = [it for line in lines for it in self._parsed(line)]
        except (ValueError, msgspec.ValidationError) as error:
            self._end(0.0)
            self.lost = f"{self.host} answers what Pancakes does not say ({error}): see what runs there"
            return []
        if found:
            self._heard_s = _NOW()
        if found and not self.begun:
            self.begun, self._noise_bytes = True, os.lseek(self._errors, 0, os.SEEK_END)
            self.flush()
        return [it for it in found if it and it.get("event") != "alive"]

    def _parsed(self, line: bytes) -> Iterator[dict[str, Any]]:
        """Yields what a line says; what stands before the marker, or has none, is of the user's shell over there.

        Raises:
            ValueError, msgspec.ValidationError: it has the marker, and is no answer.
        """
        _, marker, said = line.partition(self._marker)
        if marker:
            yield codecs.convert(plain_of(said), _Told)

    def obtain(self, do: str, within_s: float = CALL_S, kind: Any = Any, **arguments: Any) -> Any:
        """Asks for something, and waits for the answer; what the host tells meanwhile is passed over.

        Args:
            do: what is asked for.
            within_s: how long the answer may take.
            kind: the type of the answer.
            arguments: what is said with it.

        Raises:
            HostError: the host cannot do it, or its answer is none of that type.
            Unreachable: the connection has ended, or no answer comes in time.
        """
        number, began_s = self.send(do, **arguments), _NOW()
        while not self.lost:
            # One that has not begun has the whole time for it: `ssh` may go through other hosts.
            patience_s = min(began_s + within_s, max(began_s, self._heard_s) + SILENT_S if self.begun else math.inf)
            left_s = patience_s - _NOW()
            if left_s <= 0:
                self._give_up(min(within_s, SILENT_S) if self.begun else within_s)
                break
            writes = [self._out] if self.has_more else []
            readable, writable, _ = select.select([self._in], writes, [], left_s)
            if writable:
                self.flush()
            for answer in self.read() if readable else ():
                if answer.get("id") != number:
                    continue
                if "fault" in answer:
                    raise HostError(f"{self.host} {answer['fault']}")
                try:
                    return codecs.convert(answer.get("result"), kind)
                except msgspec.ValidationError as error:
                    raise HostError(f"{self.host} answers {do} with what cannot be read: {error}") from None
        raise Unreachable(self.lost)

    def send_file(self, name: str, digest: str, data: bytes, told: Callable[[int], None] = lambda sent: None) -> None:
        """Sends a wheel; `told` gets how many bytes of it are there by now. The errors are those of `obtain`."""
        for start in range(0, len(data), PIECE_BYTES):
            piece, end = data[start : start + PIECE_BYTES], start + PIECE_BYTES
            encoded = base64.b64encode(piece).decode()
            self.obtain("put", name=name, digest=digest, data=encoded, last=end >= len(data))
            told(min(end, len(data)))

    def close(self, within_s: float = 5.0) -> None:
        """Ends the connection, and with it what was launched over it."""
        self.let_go()
        with contextlib.suppress(subprocess.TimeoutExpired):
            # One that has never answered does not hear that this is over either.
            self._process.wait(within_s if self.begun else 0.0)
        self._end(0.0)

    def let_go(self) -> None:
        """Lets the host know that nothing more comes. It ends what was launched; `close` waits for that."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()

    def end_if_silent(self) -> bool:
        """Ends the connection to a host that should have said something by now; returns whether it has done so."""
        patience_s = SILENT_S if self.begun else OPEN_S
        if self.lost or _NOW() - self._heard_s < patience_s:
            return False
        self._give_up(patience_s)
        return True

    def _give_up(self, within_s: float) -> None:
        said = self._said()
        self.close(0.0)
        self.lost = silent(self.host, within_s, said)

    def _said(self) -> str:
        """Returns the end of what was said on standard error since the host began to answer."""
        size = os.lseek(self._errors, 0, os.SEEK_END)
        return os.pread(self._errors, _CHUNK, max(self._noise_bytes, size - _CHUNK)).decode("utf-8", "replace")

    def _end(self, within_s: float = 1.0) -> None:
        if self.lost:
            return
        try:
            code = self._process.wait(within_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            code = self._process.wait()
        self.lost = sentence_of(self.host, code, self._said())
        os.close(self._errors)
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with contextlib.suppress(OSError):
                pipe.close()
