"""The configurations in docs/energy.md are good as they stand there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from pancakes.runtime.config import parse
from pancakes.runtime.config.plugin_check import check_plugins
from pancakes.runtime.plugins import Plugins

GUIDE = Path(__file__).parents[2] / "docs" / "energy.md"
BLOCKS = re.findall(r"```toml\n(.*?)```", GUIDE.read_text(encoding="utf-8"), flags=re.DOTALL)
HEAD = 'schema = 1\n[agent]\nname = "a"\n[device.battery]\ndriver = "null.battery"\n'


def test_there_are_examples() -> None:
    assert len(BLOCKS) == 3


@pytest.mark.parametrize("block", BLOCKS)
def test_an_example_is_a_good_configuration(block: str) -> None:
    if "[task.EnergyGovernor]" not in block and "EnergyGovernor" in block:
        block = '[task.EnergyGovernor]\ntype = "energy.governor"\n' + block
    assert check_plugins(parse(HEAD + block, "docs/energy.md"), Plugins()) == []
