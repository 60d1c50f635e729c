"""A plug-in of a distribution of Pancakes that is not installed is answered with the command that brings it."""

from configparser import ConfigParser
from pathlib import Path

import pytest

from pancakes.config import parse
from pancakes.errors import ConfigError
from pancakes.util.entry_points import distributions
from pancakes.util.plugins import BROUGHT_BY, GROUPS, Plugins, UnknownPluginError

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def core_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the core is installed."""
    found = [it for it in distributions() if it.header("Name") == "pancakes-agents"]
    monkeypatch.setattr("pancakes.util.plugins.distributions", lambda: iter(found))


def test_the_table_has_all_that_the_distributions_beside_the_core_offer() -> None:
    offered: dict[str, dict[str, str]] = {}
    for path in (ROOT / "plugins").glob("*/setup.cfg"):
        read = ConfigParser()
        read.read(path)
        for group, points in read["options.entry_points"].items():
            for point in points.split("\n"):
                family = point.partition("=")[0].strip().partition(".")[0]
                if family and group != "pancakes.packets":
                    offered.setdefault(group, {})[family] = read["metadata"]["name"]
    assert offered == BROUGHT_BY and set(BROUGHT_BY) < set(GROUPS)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[device.d]\ndriver = "mqtt.temperature"', "unknown driver 'mqtt.temperature': pip install pancakes-mqtt"),
        ('[device.d]\ndriver = "khepera3.motor"', "unknown driver 'khepera3.motor': pip install pancakes-pi"),
        ('[service.ros2]\ntype = "ros2"', "unknown service type 'ros2': pip install pancakes-ros2"),
        (
            '[task.T]\ntype = "encirclement.GoHome"',
            "unknown task type 'encirclement.GoHome': pip install pancakes-encirclement",
        ),
        (
            'listen = "zenoh://robot:7447"',
            "unknown transport 'zenoh' in 'zenoh://robot:7447': pip install pancakes-zenoh",
        ),
    ],
)
@pytest.mark.usefixtures("core_only")
def test_a_part_that_is_not_installed_is_answered_with_what_brings_it(text: str, said: str) -> None:
    with pytest.raises(ConfigError) as raised:
        parse(f'schema = 1\n[agent]\nname = "a"\n{text}\n', "a.toml", plugins=Plugins())
    assert said in [fault.problem for fault in raised.value.faults]
    assert not any("did you mean" in str(fault) for fault in raised.value.faults)


def test_a_name_of_a_distribution_that_is_installed_is_suggested() -> None:
    with pytest.raises(UnknownPluginError, match="unknown driver 'mqtt.temprature', did you mean 'mqtt.temperature'"):
        Plugins().get("pancakes.drivers", "mqtt.temprature")
