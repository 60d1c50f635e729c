"""`dropped` is what was lost by a reader that wanted all; it is the same wherever an operator looks."""

import pytest

from pancakes.client.rates import RateMeter
from pancakes.control import Channels, Describe
from pancakes.devices import Load, Memory, Pose
from pancakes.recording.task_statistics import figures_of
from pancakes.task import Task, on
from pancakes.tools.web.fleet_model import FleetModel


class Newest(Task):
    """Wants the newest pose and nothing else, by a channel of its own and by one on which it wants all loads."""

    @on("system", Pose, queue="latest")
    def pose(self, packet):
        pass

    @on("ctrl", Pose, queue="latest")
    def command(self, packet):
        pass

    @on("ctrl", Load, queue=2)
    def load(self, packet):
        pass


@pytest.fixture
def agent(fleet):
    agent = fleet.start("a", tasks={"Newest": Newest})
    for number in range(5):  # nobody runs meanwhile
        agent.publish("system", Pose(float(number), 0.0, 0.0))
        agent.publish("ctrl", Pose(float(number), 0.0, 0.0))
        agent.publish("ctrl", Load(0.1))
    fleet.run_for(0.1)
    return agent


def test_only_what_a_reader_lost_that_wanted_all_is_counted(agent):
    told = agent.ask(Describe("client/Newest")).result
    assert told["dropped"] == 3
    assert {read["channel"]: read["dropped"] for read in told["reads"]} == {"system": 0, "ctrl": 3}


def test_a_card_the_table_the_channel_and_a_recording_say_the_same(agent):
    described = agent.ask(Describe()).result
    rows = RateMeter().update([described])
    assert (rows[0]["dropped"], {task["task"]: task["dropped"] for task in rows[0]["tasks"]}["Newest"]) == (3, 3)

    model = FleetModel()
    model.describe(rows, [described], 0.0)
    assert model.board.get("agent/a")["dropped"] == 3
    assert model.board.get("task/a/client/Newest")["dropped"] == 3

    channels = {row["channel"]: row["subscribers"] for row in agent.ask(Channels()).result}
    lost = {name: sum(it["dropped"] for it in channels[name]) for name in ("system", "ctrl")}
    assert lost == {"system": 0, "ctrl": 3}

    figures = figures_of(agent.kernel, {})
    assert [(task.task, task.dropped) for task in figures.tasks if task.dropped] == [("client/Newest", 3)]


def test_what_was_lost_stays_counted_where_one_more_type_is_listened_to(agent, fleet):
    agent.task("Newest").subscribe("ctrl", Memory, lambda packet: None)
    told = agent.ask(Describe("client/Newest")).result
    assert told["dropped"] == sum(read["dropped"] for read in told["reads"]) == 3
