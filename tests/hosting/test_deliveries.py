"""What is known of the letters for a task: no more than so many, and nothing once it has gone."""

from dataclasses import dataclass

import pytest

from pancakes.durable import hosting
from pancakes.durable.checkpoints import CameFor
from pancakes.durable.client_service import ClientServiceCore
from pancakes.durable.delivery import Letter
from pancakes.durable.record import TaskId
from pancakes.kernel.mailbox import tell
from pancakes.packet import packet_type
from pancakes.supervision.messages import Give, LetterGiven, LetterOutcome
from pancakes.task import Task, on
from pancakes.testing import Fleet


@packet_type("test.command")
@dataclass(frozen=True)
class Command:
    n: int


class Sink(Task):
    """Takes commands."""

    @on("system", Command)
    def take(self, packet):
        pass


def test_letters_that_cannot_be_read_and_never_come_again_are_forgotten_and_the_newest_are_not(monkeypatch):
    monkeypatch.setattr(hosting, "MOST_KNOWN", 4)
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Sink": Sink})
        client = agent.component("client")
        assert isinstance(client, ClientServiceCore)

        def arrive(number):
            # The second of its stream: the task waits for the first, and takes none of them.
            letter = Letter("a/Sink", f"stream{number}", 2, 1, b"", "gone")
            tell(client, CameFor(letter, None))
            fleet.run_for(0.01)

        for number in range(20):
            arrive(number)
        buried = agent.agent.kernel.dead_letters.count
        for number in range(16, 20):
            arrive(number)
        assert agent.agent.kernel.dead_letters.count == buried, "it is told of once"
        for number in range(16):
            arrive(number)
        assert agent.agent.kernel.dead_letters.count == buried + 16, "that it was told of is forgotten"


@pytest.mark.parametrize("task_id", ["a/Sink", "z/Unknown"])
@pytest.mark.parametrize("outcome", LetterOutcome)
def test_what_a_task_says_of_a_letter_that_is_not_known_any_more_means_nothing(task_id: str, outcome: LetterOutcome):
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Sink": Sink})
        sink, client = agent.component("client/Sink"), agent.component("client")
        assert isinstance(client, ClientServiceCore) and sink is not None
        letter = Letter(task_id, "stream", 1, 1, b"", "b")
        tell(client, LetterGiven(sink, Give(letter, None), outcome))
        fleet.run_for(0.1)
        assert agent.running() == ["Sink"] and agent.agent.kernel.dead_letters.count == 0
        place = client.places.get(TaskId.parse(task_id))
        assert place is None or place.letters is None
