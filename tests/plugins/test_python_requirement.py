"""On a Python that is too old, pip names what Pancakes and its plug-ins require, not what it cannot find for that."""

from configparser import ConfigParser
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

ROOT = Path(__file__).parents[2]
SETUPS = [ROOT / "setup.cfg", *sorted(ROOT.glob("plugins/*/setup.cfg"))]
UNKNOWN_BEFORE = {"pykka", "pancakes-agents"}
"""What has no version at all for Python 3.10: pip looks for what is required before it looks at `python_requires`."""


@pytest.mark.parametrize("setup", SETUPS, ids=lambda path: path.parent.name)
def test_nothing_is_asked_for_that_an_older_python_cannot_have(setup: Path):
    options = ConfigParser()
    options.read(setup, encoding="utf-8")
    required = [Requirement(line) for line in options["options"]["install_requires"].split("\n") if line.strip()]

    def needed(python: str) -> set[str]:
        return {it.name for it in required if it.marker is None or it.marker.evaluate({"python_version": python})}

    assert "3.10" not in SpecifierSet(options["options"]["python_requires"])
    assert needed("3.10").isdisjoint(UNKNOWN_BEFORE)
    assert needed("3.11") == needed("3.13") == {it.name for it in required}
    assert needed("3.11") & UNKNOWN_BEFORE
