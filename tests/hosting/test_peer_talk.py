"""What is said to the actors of other agents, and to whom nothing is said."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from pancakes.durable.messages import MayGuard, Prepare
from pancakes.durable.peer_talk import PeerTalk
from pancakes.durable.record import TaskId
from pancakes.durable.register import Epoch, Identity
from pancakes.errors import PancakesError

ASKED = MayGuard(TaskId("a", "Count"), "count")
ASKS = Prepare(TaskId("a", "Count"), "count", Epoch(1, Identity("a")), (Epoch(0, Identity("a")), 3), ())


class Speaker:
    """Notes what it publishes."""

    agent = "a"
    name = "client"

    def __init__(self) -> None:
        self.said: list[tuple[str, str]] = []
        self.lines: list[str] = []
        self.fails = False

    def publish(self, channel: str, body: Any, to: str) -> None:
        if self.fails:
            raise PancakesError("it is full")
        self.said.append((to, body.journal))

    def log(self, level: str, line: str) -> None:
        self.lines.append(line)


@pytest.fixture
def speaker() -> Speaker:
    return Speaker()


@pytest.fixture
def talk(speaker: Speaker) -> PeerTalk:
    peers = {"b": SimpleNamespace(journal="of-b"), "desk": SimpleNamespace(journal="")}
    mesh = SimpleNamespace(
        identity=SimpleNamespace(journal="of-a", boot=3, copy=""),
        connected=lambda: peers,
        seek=lambda agent: agent == "far",
    )
    return PeerTalk(cast(Any, speaker), cast(Any, mesh))


def test_a_message_is_for_the_disk_that_the_agent_has_now(talk: PeerTalk, speaker: Speaker) -> None:
    talk.say("b", "client", ASKED)
    talk.say("a", "client", ASKED)
    assert speaker.said == [("b/client", "of-b"), ("a/client", "of-a")]
    assert talk.neighbours() == ["b"]


@pytest.mark.parametrize("member", [("b", "lost"), ("a", "lost"), ("c", "of-c"), ("desk", "")])
def test_nothing_is_said_to_another_disk_or_where_there_is_no_link(
    talk: PeerTalk, speaker: Speaker, member: tuple[str, str]
) -> None:
    talk.to(Identity(*member), ASKS)
    assert speaker.said == []


def test_what_cannot_be_sent_is_lost_and_noted(talk: PeerTalk, speaker: Speaker) -> None:
    speaker.fails = True
    talk.say("b", "client", ASKED)
    assert speaker.lines == ["MayGuard did not reach b: it is full"]


def test_what_is_for_a_known_disk_waits_for_a_link_and_what_is_for_any_is_said_again(
    talk: PeerTalk, speaker: Speaker
) -> None:
    talk.to(Identity("far", "of-far"), ASKS)
    talk.say("far", "client", ASKED)
    assert speaker.said == [("far/kernel/Registrar", "of-far")]
