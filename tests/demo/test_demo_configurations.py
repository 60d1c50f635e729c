"""Where the installed demos keep their configurations."""

from pathlib import Path

from pancakes.tools.demo import Comparison
from pancakes.util.plugins import Plugins

ROOT = Path(__file__).parents[2]
DEMOS = ("encirclement", "energy", "intruder", "pioneer", "rescue", "robotarium", "sensor-field")


def test_demos_use_the_one_copy_of_their_configurations():
    for name in DEMOS:
        found = Plugins().get("pancakes.demos", name)
        mission = found.mission if isinstance(found, Comparison) else found
        assert mission.configs.resolve() == ROOT / "configs" / name
