"""Send a robot somewhere by an action of ROS 2, such as Nav2's NavigateToPose, and let the goal follow the task.

Here the action server is played by a driver, because there is no ROS 2 in virtual time. On robots the same task has
`[device.nav]` with `driver = "ros2.action"`.

$ python examples/goal_of_ros2.py
0.0 s: robot1 drives to (4, 2)
2.2 s: robot1 has 2.5 m to go
2.2 s: robot1 stands
2.3 s: robot2 drives to (4, 2)
6.5 s: the goal of Visit has succeeded on robot2
"""

from pancakes_ros2.action_task import ActionState, ActionTask, pose_goal
from pancakes_ros2.goal_packets import Goal, GoalStatus

from pancakes import Actuator, Simulation
from pancakes.control import Migrate


class Nav(Actuator):
    """Drives 1 m/s towards each goal, as long as it is commanded."""

    type = "ros2.goal"
    number = 0
    left_m = 4.5

    def write(self, command: Goal, ttl_s: float, source: str) -> None:
        self.source = source
        if command.fields is not None and command.number != self.number:
            self.number, self.left_m = command.number, 4.5
            place = command.fields["pose"]["pose"]["position"]
            print(f"{self.context.now():.1f} s: {self.context.agent} drives to ({place['x']}, {place['y']})")

    def safe_stop(self) -> None:
        if 0.0 < self.left_m < 4.5:
            print(f"{self.context.now():.1f} s: {self.context.agent} stands")
        self.number, self.left_m = 0, 0.0

    def tick(self) -> None:
        if self.number and self.left_m > 0.0:
            self.left_m -= 0.5
            status = GoalStatus("nav", self.source, self.number, "running", feedback={"left_m": self.left_m})
            if self.left_m <= 0.0:
                status = GoalStatus("nav", self.source, self.number, "succeeded")
            self.context.send("system", status, "")


class Visit(ActionTask[None, ActionState]):
    """Goes to one place, on whatever robot."""

    left_m = 0.0

    def on_start(self) -> None:
        if not self.state.number:  # not again after a migration
            self.send_goal(pose_goal(4, 2))

    def on_goal_feedback(self, status: GoalStatus) -> None:
        assert status.feedback is not None
        self.left_m = status.feedback["left_m"]

    def on_goal_end(self, status: GoalStatus) -> None:
        print(f"{self.now():.1f} s: the goal of {self.name} has {status.state} on {self.agent}")


with Simulation() as simulation:
    nav = {"type": Nav, "rate_hz": 2}
    simulation.add("robot1", devices={"nav": nav}, tasks={"Visit": Visit})
    simulation.add("robot2", devices={"nav": nav}, classes={"Visit": Visit})
    simulation.reset(seed=1)
    simulation.step(2.2)
    visit = simulation.agents["robot1"].task("Visit")
    print(f"2.2 s: robot1 has {visit.left_m} m to go")
    simulation.agents["robot1"].ask(Migrate("Visit", to="robot2"))
    simulation.step(6)
