"""Registers and records in each standing, for tests."""

from __future__ import annotations

from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Epoch, Identity, Register, Standing, Wanted

A, B, C, D = (Identity(name, f"disk of {name}") for name in "abcd")
TASK = TaskId("a", "Scan")
FIRST = Epoch(0, A)
STATE = b"begun"
OWNED = Register(FIRST, 3, ((A,),), state=STATE, promised=FIRST)
GUARDED = OWNED._replace(sets=((A, B, C),))
REGISTERS: dict[Standing, Register] = {
    Standing.NONE: Register(),
    Standing.OWNER: OWNED,
    Standing.OFFERED: OWNED._replace(heir=B),
    Standing.YIELDED: OWNED._replace(heir=B, promised=Epoch(1, B, 4)),
    Standing.DISPUTED: OWNED._replace(wanted=Wanted.DISPUTED),
    Standing.HEIR: Register(Epoch(2, B), 5, ((B,),), heir=A, state=STATE, promised=Epoch(2, B)),
    Standing.MEMBER: Register(Epoch(2, B), 5, ((A, B, C),), state=STATE, promised=Epoch(2, B)),
    Standing.RELEASED: Register(Epoch(2, B), -1, ((B,),), promised=Epoch(2, B)),
}
"""A register of A in each standing."""


def record(register: Register | Standing = OWNED, sequel: bytes = b"") -> Record:
    """Return the record of A with a register, or with the one of a standing."""
    held = REGISTERS[register] if isinstance(register, Standing) else register
    return Record(TASK, held, A, "client", "test.Scan", sequel=sequel)
