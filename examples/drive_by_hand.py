"""Drive a robot by hand from a program, as `pancakes drive` and the page do.

The task that has the wheels waits with its state while alice drives, and goes on by itself: after her `EndDrive`, or
when her program has been silent for five seconds. The robot stops half a second after her last command.

$ python examples/drive_by_hand.py
1 s: Circle drives at 0.1 m/s
alice drives, and robot1/client/Circle waits
2 s: alice drives at -0.2 m/s
bob: alice drives motors by hand already
4 s: the wheels stand
8 s: Circle drives at 0.1 m/s
"""

from pancakes import Actuator, Simulation, Task, Tick, every
from pancakes.control import Drive
from pancakes.devices import Twist

now = "the wheels stand"


class Wheels(Actuator):
    type = "motors"

    def write(self, command: Twist, ttl_s: float, source: str) -> None:
        global now
        who = "alice" if source == "robot1/device/drive-motors" else source.split("/")[-1]
        now = f"{who} drives at {command.v_mps} m/s"

    def safe_stop(self) -> None:
        global now
        now = "the wheels stand"


class Circle(Task):
    requires = ("motors",)

    @every(hz=10)
    def drive(self, tick: Tick) -> None:
        self.publish("ctrl", Twist(0.1, 0.5))


with Simulation() as simulation:
    simulation.add("robot1", devices={"motors": Wheels}, tasks={"Circle": Circle})
    simulation.add("alice", role="client").add("bob", role="client")
    simulation.reset(seed=1)
    simulation.step(1)
    print(f"1 s: {now}")
    alice, bob = simulation.agents["alice"], simulation.agents["bob"]
    reply = alice.ask(Drive("motors", id="a", begin=True), to="robot1")
    print(f"alice drives, and {reply.result['paused']} waits")
    for _ in range(10):  # ten times a second: a command is good for half a second
        alice.ask(Drive("motors", id="a", v_mps=-0.2), to="robot1")
        simulation.step(0.1)
    print(f"2 s: {now}")
    print("bob:", bob.ask(Drive("motors", id="b", begin=True), to="robot1").reason.partition(":")[0])
    simulation.step(2)
    print(f"4 s: {now}")
    simulation.step(4)
    print(f"8 s: {now}")
