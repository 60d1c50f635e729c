"""The packets by which agents decide which of them has a task: their form on the wire, and for whom they are."""

from __future__ import annotations

from typing import Any, get_args

import msgpack
import msgspec
import pytest
from register.registers import GUARDED, OWNED, TASK, A, B, C

from pancakes.control import Refusal
from pancakes.durable import messages
from pancakes.durable.messages import MOST_ASKED, Fact, addressed, is_for
from pancakes.durable.record import TaskId
from pancakes.durable.register import Epoch, Register, Wanted
from pancakes.packet import body_from_plain, known_types, type_name

EPOCH = Epoch(1, B, 7)
WRITTEN = GUARDED.as_written().summary()
SOLICIT = messages.Solicit(TASK, 1, "test.Scan", "0.1.0", "client", ("pose",), "tasks", 0.65)
SAMPLES: list[Any] = [
    SOLICIT,
    msgspec.structs.replace(SOLICIT, hold=True),
    messages.Bid(TASK, 1, 2.0, {"active tasks": 2.0}, holds=True, by=B),
    messages.Refuse(TASK, 1, Refusal("unsupported", "lacks the device type motors")),
    messages.Accept(TASK, "test.Scan", "client", WRITTEN, 3, 2.0, B, b"state", 1.5),
    messages.Piece(TASK, OWNED.stamp, 0, 1, 5, b"digest", b"state"),
    messages.Accepted(TASK, EPOCH, B, 3, 4, 5),
    messages.Prepare(TASK, "test.Scan", EPOCH, OWNED.stamp, GUARDED.sets),
    messages.Promise(TASK, EPOCH, B, WRITTEN._replace(promised=EPOCH), b"state"),
    messages.WhoHas((TASK,), silent=True),
    messages.Known(B, (TASK,), (Fact(TASK, WRITTEN, True, True, 1.5, "c"),)),
    messages.BootRemembered("disk", 3, "third"),
    messages.Call(TASK, "test.Scan", "client", EPOCH, GUARDED.sets, 2.5),
    messages.MayGuard(TASK, "test.Scan"),
    messages.CanGuard(TASK, B, "", True, False, 600.0),
]


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda it: type(it).__name__)
def test_message_travels_as_a_packet(sample: Any) -> None:
    plain = msgpack.unpackb(msgspec.msgpack.encode(sample))
    assert body_from_plain(type_name(sample), plain) == sample


def test_each_type_of_message_has_a_sample() -> None:
    kinds = {name for name in known_types() if name.startswith(("migration.", "task."))}
    of_module = {name for name in kinds if known_types()[name].__module__ == messages.__name__}
    assert {type_name(sample) for sample in SAMPLES} == of_module


@pytest.mark.parametrize("kind", get_args(messages.ToPeer), ids=lambda it: it.__name__)
def test_message_is_believed_only_by_the_journal_that_it_is_for(kind: Any) -> None:
    message = addressed(next(it for it in SAMPLES if type(it) is kind), "disk of b")
    assert is_for(message, "disk of b")
    assert not is_for(message, "another disk")


@pytest.mark.parametrize(
    ("message", "field", "value"),
    [
        (SAMPLES[4], "lease_s", 0.1),
        (SAMPLES[4], "lease_s", 1e6),
        (SAMPLES[4], "age_s", -1.0),
        (SAMPLES[6], "no", -2),
        (SAMPLES[7], "sets", (((A,),) * 3)),
        (SAMPLES[7], "sets", ((),)),
        (SAMPLES[7], "sets", ((A, B, C, A, B, C),)),
        (SAMPLES[7], "epoch", Epoch(-2, B)),
        (SAMPLES[7], "epoch", Epoch(1, B._replace(agent="b c"))),
        (SAMPLES[9], "task_ids", tuple(TaskId("a", f"T{number}") for number in range(MOST_ASKED + 1))),
    ],
)
def test_message_with_an_impossible_value_is_refused(message: Any, field: str, value: Any) -> None:
    wrong = msgspec.msgpack.encode(msgspec.structs.replace(message, **{field: value}))
    with pytest.raises(Exception, match=r"\$|Expected|Invalid|malformed|bad"):
        body_from_plain(type_name(message), msgpack.unpackb(wrong))


def test_fact_tells_the_epoch_the_owner_and_a_removal() -> None:
    fact = Fact(TASK, Register(Epoch(1, B), 4, ((B,),), promised=Epoch(3, C)))
    assert (fact.epoch, fact.removed) == (Epoch(3, C), False)
    gone = Fact(TASK, fact.register._replace(wanted=Wanted.REMOVED))
    assert (gone.removed, gone.owner) == (True, "")
