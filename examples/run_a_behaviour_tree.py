"""Run a mission as a behaviour tree, which goes on where it was after a migration and after the loss of a robot.

The tree drives to a shelf, loads for 3 s, and drives back. Robot 1 hands it over on its way to the shelf; robot 2 loses
its power on its way back.

$ python examples/run_a_behaviour_tree.py
robot1 at To the shelf: 3.0 m to go
handed over: ok
robot2 at To the shelf: 2.1 m to go
robot2 at Load
robot2 at Back: 4.1 m to go
robot2 is gone
the next robot goes on at Back
the mission ended with SUCCESS, 1 box is there
"""

from dataclasses import dataclass

from py_trees.behaviour import Behaviour
from py_trees.common import Status
from py_trees.composites import Sequence

from pancakes import CTRL, Simulation
from pancakes.control import Migrate
from pancakes.devices import Twist
from pancakes.trees import TaskBehaviour, Timer, TreeState, TreeTask

SPEED_MPS = 0.5


class Drive(TaskBehaviour):
    """Drive straight ahead for some metres."""

    keeps = ("to_go_m",)  # travels with the tree; all else is made again on each robot

    def __init__(self, name: str, way_m: float) -> None:
        super().__init__(name)
        self.way_m = way_m
        self.to_go_m = 0.0
        self.seen_s = 0.0

    def setup(self, **kwargs: object) -> None:
        self.seen_s = self.task.now()  # on the next robot it counts from its arrival there

    def initialise(self) -> None:
        self.to_go_m = self.way_m
        self.seen_s = self.task.now()

    def update(self) -> Status:
        now_s = self.task.now()
        self.to_go_m -= SPEED_MPS * (now_s - self.seen_s)
        self.seen_s = now_s
        self.feedback_message = f"{self.to_go_m:.1f} m to go"
        arrived = self.to_go_m <= 0.0
        self.task.publish(CTRL, Twist(0.0 if arrived else SPEED_MPS, 0.0))
        return Status.SUCCESS if arrived else Status.RUNNING


@dataclass
class FetchState(TreeState):
    ended: str = ""


class Fetch(TreeTask[None, FetchState]):
    requires = ("motors",)

    def make_tree(self) -> Behaviour:
        steps = [Drive("To the shelf", 5.0), Timer("Load", 3.0), Drive("Back", 5.0)]
        return Sequence("Fetch a box", memory=True, children=steps)

    def on_end(self, status: Status) -> None:
        self.state.ended = status.name
        self.blackboard["boxes"] = self.blackboard.get("boxes", 0) + 1
        self.reschedule(0.0, "tick_tree")  # else the next tick begins the tree again


def running(robot: str) -> str:
    """Return the innermost running node of the tree on a robot, and its message."""
    node = [it for it in simulation.task(robot, "Fetch").state.nodes if it.status == "RUNNING"][-1]
    return f"{node.name}: {node.message}" if node.message else str(node.name)


GUARD = {"copies": 3, "lease_s": 2.0, "checkpoint_s": 0.5}
MOTORS = {"motors": "null.motors"}

with Simulation() as simulation:
    simulation.add("robot1", devices=MOTORS, tasks={"Fetch": {"type": Fetch, "rate_hz": 4, "guard": GUARD}})
    simulation.add("robot2", devices=MOTORS)
    simulation.add("robot3", devices=MOTORS)
    simulation.reset(seed=1)
    simulation.step(4.4)
    print("robot1 at", running("robot1"))
    reply = simulation.agents["robot1"].ask(Migrate("Fetch", to="robot2"))
    print("handed over:", "ok" if reply.ok else reply.reason)
    simulation.step(2.0)
    print("robot2 at", running("robot2"))
    simulation.step(4.5)
    print("robot2 at", running("robot2"))
    simulation.step(4.5)
    print("robot2 at", running("robot2"))
    simulation.crash("robot2")
    print("robot2 is gone")
    simulation.step_until(lambda: bool(simulation.where("Fetch")), 10.0)
    (robot,) = simulation.where("Fetch")
    print("the next robot goes on at", running(robot).partition(":")[0])
    simulation.step(15.0)
    task = simulation.task(robot, "Fetch")
    print(f"the mission ended with {task.state.ended}, {task.blackboard['boxes']} box is there")
