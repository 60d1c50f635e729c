"""Lets the tests of this directory import what lies beside them."""

from __future__ import annotations

import sys
from pathlib import Path

for directory in (Path(__file__).parent, Path(__file__).parents[1] / "demo"):
    sys.path.insert(0, str(directory))
