"""The connection of a program that is no agent: what it asks is answered, or it is told why not."""

from __future__ import annotations

from typing import Any

import pancakes.events  # noqa: F401 - it registers the type of a line of the log
from pancakes.client.session import FleetSession
from pancakes.control import Describe, Reply
from pancakes.packet import LOG, SYSCTRL, Packet


def test_news_of_what_was_asked_that_cannot_be_read_is_no_answer(memory_rig):
    agent = memory_rig.agent("a")
    session = FleetSession("cli", "default", memory_rig.transport("cli"), memory_rig.clock, lambda: None)
    unread = []
    session.listen(lambda peer, packet: None, lambda *it: unread.append(it))
    session.learn(agent.address)
    memory_rig.until(lambda: session.is_connected("a") and agent.knows("cli"))
    number = session.request("a", Describe())
    agent.mesh.send(Packet(LOG, "line", "a/root", "cli", 0.0, 1, {"level": 7}, cause=("cli", number)))
    agent.mesh.send(Packet(SYSCTRL, "reply", "a/root", "cli", 0.0, 2, Reply(), cause=("cli", number)))
    memory_rig.until(lambda: session.answer(number))
    assert session.answer(number) == Reply()
    ((peer, packet, reason),) = unread
    assert (peer, packet.type, packet.body) == ("a", "line", None) and "type 'line'" in reason


def test_an_answer_that_cannot_be_read_is_an_answer_and_costs_no_link(memory_rig):
    agent = memory_rig.agent("a")
    session = FleetSession("cli", "default", memory_rig.transport("cli"), memory_rig.clock, lambda: None)
    session.learn(agent.address)
    memory_rig.until(lambda: session.is_connected("a") and agent.knows("cli"))
    bad, good = session.request("a", Describe()), session.request("a", Describe())
    perhaps: Any = "perhaps"
    for number, place in ((bad, perhaps), (good, 0)):
        reply = Packet(SYSCTRL, "reply", "a/root", "cli", 0.0, number, Reply(number=place), cause=("cli", number))
        agent.mesh.send(reply)
    memory_rig.until(lambda: session.answer(good))

    assert session.answer(good) == Reply()
    answer = session.answer(bad)
    assert isinstance(answer, str)
    assert "its answer cannot be read: a packet of the type 'reply' has a bad body" in answer
    assert session.is_connected("a")
