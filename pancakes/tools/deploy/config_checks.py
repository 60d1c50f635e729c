"""Checks configurations with the wheels that are to be brought, on this machine: before a host is touched."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from typing import Final

from pancakes.errors import PancakesError
from pancakes.tools.deploy.wheels import Wheel
from pancakes.tools.launch.member import Member

PROGRAM: Final = """
import json, sys
from pancakes.errors import ConfigError
from pancakes.runtime.config import load
from pancakes.runtime.plugins import Plugins

plugins, faults = Plugins(), []
for path, sets in json.load(sys.stdin):
    try:
        load(path, sets, plugins)
    except ConfigError as error:
        faults += [str(fault) for fault in error.faults]
print(json.dumps(faults))
"""


def check_configs(members: Sequence[Member], own: Sequence[Wheel]) -> str:
    """Checks the configurations of agents as the Pancakes and the plug-ins in some wheels read them.

    Args:
        members: the agents.
        own: the wheels of Pancakes and its plug-ins.

    Returns:
        Why that cannot be done on this machine, as a clause; empty: it is done.

    Raises:
        PancakesError: some are not sound; the sentences name file, line and key.
    """
    with tempfile.TemporaryDirectory(prefix="pancakes-check-") as folder:
        for wheel in own:
            with zipfile.ZipFile(wheel.path) as archive:
                archive.extractall(folder)
        environment = {**os.environ, "PYTHONPATH": folder}
        asked = json.dumps([(str(member.path), member.sets) for member in members])
        done = subprocess.run(
            [sys.executable, "-P", "-c", PROGRAM], input=asked, capture_output=True, text=True, env=environment
        )
    try:
        faults: list[str] = json.loads(done.stdout)
    except ValueError:  # those wheels need libraries that this machine lacks
        return next((line for line in reversed(done.stderr.splitlines()) if line.strip()), "its check says nothing")
    if faults:
        raise PancakesError("\n".join([*dict.fromkeys(faults), "nothing was brought to a host"]))
    return ""
