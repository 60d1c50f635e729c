"""Runs `pancakes deploy` as a person does."""

from __future__ import annotations

import subprocess
from pathlib import Path

from cli.processes import Rig, pancakes
from harness.programs import run

DEPLOY_S = 280.0


def deploy(rig: Rig, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the verb."""
    command = pancakes("deploy", *map(str, arguments))
    done = run(command, timeout_s=DEPLOY_S, env=rig.environment, cwd=rig.directory)
    assert "Traceback" not in done.stderr
    return done
