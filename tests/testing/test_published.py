"""`assert_published`: how long it waits, and what it says of what there was instead."""

from __future__ import annotations

import pytest

from pancakes.devices import Load, Memory
from pancakes.task import Task, every
from pancakes.testing import assert_published


class Blink(Task):
    @every(hz=2)
    def blink(self, tick):
        self.publish("system", Load(tick.time_s))


@pytest.fixture
def agent(any_agent):
    """An agent that publishes a `Load` twice a second: 0.5, 1.0, and so on."""
    return any_agent(tasks={"Blink": Blink}, speed=20.0)


def test_it_waits_for_the_first_that_fits(agent):
    assert assert_published(agent, Load, lambda load: load.cpu >= 3.0).body.cpu >= 3.0


def test_it_waits_no_longer_than_it_is_told(fleet, virtual_agent):
    agent = virtual_agent(tasks={"Blink": Blink})
    began_s = fleet.now()
    with pytest.raises(AssertionError, match="0 packets of the type 'memory' fit, at least one wanted within 3 s on a"):
        assert_published(agent, Memory, within_s=3.0)
    assert fleet.now() == pytest.approx(began_s + 3.0)


def test_without_a_time_it_counts_what_there_is(fleet, virtual_agent):
    agent = virtual_agent(tasks={"Blink": Blink})
    began_s = fleet.now()
    with pytest.raises(AssertionError, match="0 packets of the type 'load' fit, 1 wanted on a"):
        assert_published(agent, Load, times=1)
    assert fleet.now() == began_s


def test_a_count_is_exact_at_the_end_of_the_time(virtual_agent):
    agent = virtual_agent(tasks={"Blink": Blink})
    assert_published(agent, Load, times=4, within_s=2.2)
    with pytest.raises(AssertionError, match="5 packets of the type 'load' fit, 4 wanted within 9 s"):
        assert_published(agent, Load, times=4, within_s=9.0)
    assert_published(agent, Load, lambda load: load.cpu > 1000.0, times=0, within_s=5.0)


def test_it_says_which_of_the_same_type_there_were(virtual_agent):
    agent = virtual_agent(tasks={"Blink": Blink})
    with pytest.raises(AssertionError) as error:
        assert_published(agent, Load, lambda load: load.cpu < 0, channel="system", source="a/client/X", within_s=1.2)
    assert str(error.value) == (
        "0 packets of the type 'load' fit, at least one wanted within 1.2 s on a"
        " (on system, of a/client/X, that `where` takes); of the type 'load' there were 2, the last of them:\n"
        "# on system\ntype: load\nsource: a/client/Blink\nstamp_s: 0.5\nnumber: 1\nbody:\n  cpu: 0.5\n---\n"
        "# on system\ntype: load\nsource: a/client/Blink\nstamp_s: 1\nnumber: 2\nbody:\n  cpu: 1\n---"
    )


def test_it_says_what_was_published_where_there_was_none_of_the_type(agent):
    with pytest.raises(AssertionError) as error:
        assert_published(agent, Memory, within_s=0.3)
    assert "none of this type; what was published instead:\n" in str(error.value)
    assert "# the last of " in str(error.value)
    assert " on log\ntype: event\nsource: a/client\n" in str(error.value)


def test_it_says_so_where_nobody_said_anything(virtual_agent, probe):
    ears = probe(virtual_agent(), "ctrl")
    with pytest.raises(AssertionError, match="nothing at all was published$"):
        assert_published(ears, Load, within_s=1.0)


class Opens(Task):
    """Open a channel of its own, speaks there at once, and later again."""

    def on_start(self):
        self.open_channel("camera")
        self.publish("camera", Load(0.25))

    @every(hz=2)
    def look(self, tick):
        self.publish("camera", Load(0.75))


def test_it_finds_what_is_published_on_a_channel_that_is_opened_at_the_start_of_a_task(any_agent):
    agent = any_agent(tasks={"Opens": Opens}, speed=20.0)
    assert assert_published(agent, Load, lambda load: load.cpu == 0.25).channel == "camera"
    assert_published(agent, Load, lambda load: load.cpu == 0.75, channel="camera", source="a/client/Opens")


def test_a_channel_that_is_closed_and_opened_again_is_heard_once(virtual_agent):
    class Reopens(Task):
        def on_start(self):
            self.open_channel("camera")
            self.close_channel("camera")
            self.open_channel("camera")
            self.publish("camera", Load(0.5))

    assert_published(virtual_agent(tasks={"Reopens": Reopens}), Load, channel="camera", times=1, within_s=1.0)


def test_a_wait_that_fails_shows_the_log_as_the_command_line_does(virtual_agent):
    agent = virtual_agent(tasks={"Blink": Blink})
    with pytest.raises(AssertionError) as error:
        agent.wait_for(Memory, timeout_s=1.0)
    assert "LogLine(" not in str(error.value)
    assert "Event(" not in str(error.value)
    assert "task_started" in str(error.value)
