"""Missions in virtual time, each in a Python of its own with a hash seed of its own."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from harness.programs import Program, pancakes

PATIENCE_S = 300.0


class Started:
    """`pancakes demo NAME --virtual --faults` in a process; used in a `with` statement.

    Args:
        name: the demo.
        out: the folder for its results.
        hash_seed: what Python mixes into the hashes of strings.
        arguments: the rest of the command line.
    """

    def __init__(self, name: str, out: Path, hash_seed: int, *arguments: str) -> None:
        self._process = Program(
            pancakes("demo", name, "--virtual", "--faults", "--out", str(out), *arguments),
            true_start=True,  # a hash seed is that of a whole Python
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONHASHSEED": str(hash_seed)},
        )

    def __enter__(self) -> Started:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()

    def ends(self, code: int) -> str:
        """Waits until it has ended with an exit code; returns what it said."""
        said, _ = self._process.communicate(timeout=PATIENCE_S)
        assert self._process.returncode == code, said
        return said
