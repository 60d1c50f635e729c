"""What an agent keeps of all that ever happened to it: nothing that has no bound."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from soak.held import held_by

from pancakes.config import parse
from pancakes.control import Follow, Migrate, Reschedule, Restart, Start, Stop, Unfollow
from pancakes.durable import answers
from pancakes.durable.store import KEPT as LEDGERS
from pancakes.errors import MailboxFullError
from pancakes.kernel import dead_letters, stream
from pancakes.packet import NEIGHBOURS, SYSCTRL, SYSTEM, Packet, join, packet_type, type_name
from pancakes.simulation.fleet import Fleet
from pancakes.task import Task, Tick, every, on, reliable

ROUNDS = 8
STATE_BYTES = 32 * 1024
# All of them have bounds, which are not reached here; the last one is the harness'.
MAY_GROW = (
    "PeerCounters.", "Incoming.", "LinkLog._last_reason", "PeerClocks.", "MemoryNetwork."
)  # fmt: skip


@packet_type("grows.word")
@dataclass(frozen=True, slots=True)
class Word:
    count: int


class Talker(Task):
    """Talks to everybody and to one task, also in its end; fails now and then."""

    @dataclass
    class State:
        said: int = 0
        heard: int = 0
        load: bytes = bytes(STATE_BYTES)

    state: State

    @every(hz=2)
    def talk(self, tick: Tick) -> None:
        self.state.said += 1
        self.publish(SYSTEM, Word(self.state.said), to=NEIGHBOURS)
        self.tell(self.state.said)

    def tell(self, count: int) -> None:
        try:
            self.publish(SYSTEM, Word(count), to="task:a/Home")
        except MailboxFullError:
            pass

    @on(SYSTEM, Word, queue=reliable(64))
    def hear(self, packet: Packet) -> None:
        self.state.heard += 1
        if packet.body.count < 0 and self.state.heard % 5 == 0:
            raise RuntimeError("it would not hear of an end")

    def on_stop(self) -> None:
        self.tell(-1)


def config(name: str, port: int, *tasks: str) -> str:
    peers = 'peers = ["tcp://127.0.0.1:7400"]' if name != "a" else ""
    lines = [f'schema = 1\n[agent]\nname = "{name}"\nlisten = "tcp://127.0.0.1:{port}"\n{peers}']
    lines.append("[service.log]\nsettings = { console = false, remembered = 20 }")
    restart = '{ policy = "always", at_most = 100000, within_s = 1 }'
    lines += [f'[task.{task}]\ntype = "grows.Talker"\nrestart = {restart}' for task in tasks]
    return "\n".join(lines)


class Trouble:
    """Two agents that stay, and a third that is another one each time."""

    def __init__(self) -> None:
        self.fleet = Fleet(1, classes={"grows.Talker": Talker})
        self.rounds = 0
        for name, port, tasks in (("a", 7400, ("Home", "Walk")), ("b", 7401, ("Roam",))):
            self.start(name, port, *tasks)
        self.fleet.run_for(3.0)

    def start(self, name: str, port: int, *tasks: str) -> None:
        self.fleet.start_config(parse(config(name, port, *tasks), name), settle=False, probe=False)

    def ask(self, agent: str, body: object, by: str = "") -> None:
        kernel = self.fleet.agents[by or agent].kernel
        source = join(by or agent, "client")
        packet = Packet(
            SYSCTRL, type_name(body), source, agent, kernel.mission.now(), kernel.seq_of(source).take(), body
        )
        kernel.stream.publish(packet)
        self.fleet.run_for(0.4)

    def home_of(self, task: str) -> str:
        there = [name for name in "ab" if self.fleet.agents[name].kernel.registry.get(f"{name}/client/{task}")]
        assert there, f"{task} runs nowhere"
        return there[0]

    def move(self, task: str) -> None:
        home = self.home_of(task)
        self.ask(home, Migrate(f"client/{task}", to="b" if home == "a" else "a"))
        self.fleet.run_for(1.0)

    def one_round(self) -> None:
        """Everything once, and a rest."""
        self.rounds += 1
        guest = f"guest{self.rounds}"
        self.start(guest, 7410)
        self.fleet.run_for(2.0)
        for task in ("Walk", "Roam", "Walk", "Roam"):
            self.move(task)
        home = self.home_of("Walk")
        self.ask(home, Stop("client/Walk"))
        self.ask(home, Start("client/Walk"))
        self.ask(home, Restart("client/Walk"))
        self.ask(home, Reschedule("client/Walk", 2.0 + self.rounds / 100, timer="talk"))
        self.ask("a", Follow(SYSTEM, most_hz=1.0), by="b")
        self.ask("a", Unfollow(SYSTEM), by="b")
        self.ask("a", Stop("network", for_s=0.5))
        self.ask("a", Restart("log"))
        if self.rounds % 2:
            self.fleet.stop(guest)
        else:
            self.fleet.crash(guest)
        self.fleet.run_for(20.0)


@pytest.fixture(scope="module")
def trouble():
    made = Trouble()
    for _ in range(2 * LEDGERS):  # so many accounts of moves are kept, on either side
        made.move("Walk")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(answers, "MOST_AGENTS", 3)  # bounds that are reached here, and hold
        patch.setattr(dead_letters, "MOST_TOLD", 3)
        patch.setattr(stream, "MOST_ROUTES", 32)  # one for each agent that ever was spoken to
        for _ in range(2):
            made.one_round()
        yield made
    made.fleet.close()


def test_nothing_grows_with_what_has_happened(trouble):
    agents = [trouble.fleet.agents[name].agent for name in "ab"]
    harness = trouble.fleet, trouble.fleet.agents  # which keep something of each agent that ever was
    before = [held_by(agent, *harness) for agent in agents]
    for _ in range(ROUNDS):
        trouble.one_round()
    for agent, was in zip(agents, before, strict=True):
        now = held_by(agent, *harness)
        assert [it for it in now.grown_since(was, ROUNDS // 2) if not it.startswith(MAY_GROW)] == []
        assert now.size_bytes < was.size_bytes + STATE_BYTES
