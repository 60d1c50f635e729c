"""What the program for a person at a terminal is called."""

from __future__ import annotations

from typing import Final

PROGRAM: Final = "pancakes"
VARIABLE: Final = "_PANCAKES_COMPLETE"
"""The environment variable with which a shell asks how the line may go on."""
