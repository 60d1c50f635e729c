"""What is kept of letters whose sender has gone: no more than so many."""

from dataclasses import dataclass

from pancakes.mesh.migration.post import Letter
from pancakes.packet import packet_type
from pancakes.runtime.hosting import task_letters
from pancakes.runtime.hosting.client import ClientService
from pancakes.runtime.hosting.deliveries import CameFor
from pancakes.runtime.kernel.tell import tell
from pancakes.task import Task, on
from pancakes.testing import FleetInTest


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
    monkeypatch.setattr(task_letters, "MOST_KNOWN", 4)
    with FleetInTest() as fleet:
        agent = fleet.start("a", tasks={"Sink": Sink})
        client = agent.component("client")
        assert isinstance(client, ClientService)

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
