"""Runs `pancakes deploy` as a person does."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from cli.processes import Rig

DEPLOY_S = 280.0


def deploy(rig: Rig, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the verb."""
    command = [sys.executable, "-m", "pancakes.tools.cli.main", "deploy", *map(str, arguments)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=DEPLOY_S, env=rig.environment, cwd=rig.directory
    )
    assert "Traceback" not in done.stderr
    return done
