"""The connection of a program that is no agent: what it asks is answered, or it is told why not."""

from __future__ import annotations

from typing import Any

import pancakes.events  # noqa: F401 - it registers the type of a line of the log
from pancakes.client.session import Door
from pancakes.control import Describe, Reply
from pancakes.packet import LOG, SYSCTRL, Packet


def test_news_of_what_was_asked_that_cannot_be_read_is_no_answer(memory_rig):
    agent = memory_rig.agent("a")
    door = Door("cli", "default", memory_rig.transport("cli"), memory_rig.clock, lambda: None)
    unread = []
    door.listen(lambda peer, packet: None, lambda *it: unread.append(it))
    door.learn(agent.address)
    memory_rig.until(lambda: door.connected("a") and agent.knows("cli"))
    number = door.request("a", Describe())
    agent.mesh.send(Packet(LOG, "line", "a/root", "cli", 0.0, 1, {"level": 7}, cause=("cli", number)))
    agent.mesh.send(Packet(SYSCTRL, "reply", "a/root", "cli", 0.0, 2, Reply(ok=True), cause=("cli", number)))
    memory_rig.until(lambda: door.answer(number))
    assert door.answer(number) == Reply(ok=True)
    ((peer, packet, reason),) = unread
    assert (peer, packet.type, packet.body) == ("a", "line", None) and "type 'line'" in reason


def test_an_answer_that_cannot_be_read_is_an_answer_and_costs_no_link(memory_rig):
    agent = memory_rig.agent("a")
    door = Door("cli", "default", memory_rig.transport("cli"), memory_rig.clock, lambda: None)
    door.learn(agent.address)
    memory_rig.until(lambda: door.connected("a") and agent.knows("cli"))
    bad, good = door.request("a", Describe()), door.request("a", Describe())
    perhaps: Any = "perhaps"
    for number, ok in ((bad, perhaps), (good, True)):
        reply = Packet(SYSCTRL, "reply", "a/root", "cli", 0.0, number, Reply(ok=ok), cause=("cli", number))
        agent.mesh.send(reply)
    memory_rig.until(lambda: door.answer(good))

    assert door.answer(good) == Reply(ok=True)
    answer = door.answer(bad)
    assert isinstance(answer, str)
    assert "its answer cannot be read: a packet of the type 'reply' has a bad body" in answer
    assert door.connected("a")
