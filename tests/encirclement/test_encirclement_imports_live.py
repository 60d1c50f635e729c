"""What an agent loads with the demos."""

from __future__ import annotations

import subprocess
import sys


def test_demos_load_without_matplotlib() -> None:
    code = "import sys, pancakes_encirclement.demos; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
