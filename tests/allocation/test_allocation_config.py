"""What a configuration may say about the team's allocation."""

from __future__ import annotations

import pytest

from pancakes.config import check_plugins, load
from pancakes.errors import ConfigError
from pancakes.util.plugins import Plugins

PART = "[service.network]\nsettings = { allocation = { at_most = 2 } }\n"


def faults(tmp_path, rule: str, part: str = PART) -> str:
    """Returns the sentences about a task's rule; empty: the file is good."""
    path = tmp_path / "robot.toml"
    path.write_text(
        f'schema = 1\n[agent]\nname = "robot"\n{part}[task.Watch]\ntype = "energy.governor"\nmigrate = {{ {rule} }}\n'
        "settings = { tasks = { Other = { rate_hz = { least = 1, most = 2 } } } }\n"
    )
    try:
        found = check_plugins(load(path), Plugins())
    except ConfigError as error:
        found = list(error.faults)
    return "\n".join(text for fault in found if "migrate" in (text := str(fault)) or "network" in text)


@pytest.mark.parametrize(
    "rule",
    [
        'when = "allocation"',
        'when = "allocation", cost = { battery = 2.0 }, value = 9.5, move_price = 0.0, again_s = 5.0',
        'when = "allocation", takes_mission_s = 4, ends_by_mission_s = 60, after = ["Other"], together = ["Another"]',
    ],
)
def test_a_rule_of_the_allocation_is_good(tmp_path, rule: str) -> None:
    assert faults(tmp_path, rule) == ""


@pytest.mark.parametrize(
    ("rule", "key", "sentence"),
    [
        ('when = "allocation", below = 0.2', "below", "is only for a rule that watches readings"),
        ('when = "allocation", then = "Watch"', "then", "is only for a rule that watches readings"),
        ('when = "battery", below = 0.2, value = 3.0', "value", "is only for when = 'allocation'"),
        ('when = "battery", below = 0.2, after = ["Other"]', "after", "is only for when = 'allocation'"),
        ('when = "allocation", value = 0', "value", "expected a number > 0 and at most 1e+12, not 0"),
        ('when = "allocation", value = nan', "value", "nan"),
        ('when = "allocation", value = 1e13', "value", "at most 1e+12, not 1e+13"),
        ('when = "allocation", move_price = -1', "move_price", "expected a number from 0 to 1e+12, not -1"),
        ('when = "allocation", takes_mission_s = inf', "takes_mission_s", "inf"),
        ('when = "allocation", ends_by_mission_s = nan', "ends_by_mission_s", "nan"),
        ('when = "allocation", after = ["Watch"]', "after", "names the task itself"),
        ('when = "allocation", together = ["Watch"]', "together", "names the task itself"),
        ('when = "allocation", cost = "nonsense"', "cost", "nonsense"),
        ('when = "allocation", worth = 3', "worth", ""),
    ],
)
def test_a_rule_that_cannot_be_meant_is_refused_by_key(tmp_path, rule: str, key: str, sentence: str) -> None:
    told = faults(tmp_path, rule)
    assert key in told and sentence in told


def test_a_task_that_is_allocated_needs_an_agent_that_takes_part(tmp_path) -> None:
    assert "takes no part in the allocation" in faults(tmp_path, 'when = "allocation"', part="")
    assert faults(tmp_path, 'when = "allocation"', part="[service.network]\nsettings = { allocation = {} }\n") == ""


@pytest.mark.parametrize("part", ["at_most = -1", "at_most = 257", "crowding = -0.5", "crowding = nan", "most = 3"])
def test_the_part_of_an_agent_is_checked(tmp_path, part: str) -> None:
    text = f"[service.network]\nsettings = {{ allocation = {{ {part} }} }}\n"
    assert part.split()[0] in faults(tmp_path, 'when = "allocation"', part=text)
