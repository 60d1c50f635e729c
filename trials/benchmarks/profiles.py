"""`scripts/bench --profile TOPIC`: where the time of a topic goes, function by function, in all its processes.

py-spy looks from outside, many times a second, which thread of each process has the interpreter, and what it is in. So
no function looks dearer than it is for being small, as with cProfile, and threads that wait are not seen. It needs no
rights beyond those of who starts it. Each look stops the process for a moment: the figures of such a run count nothing.
"""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.environments import PYSPY, ROOT, python_of

RATE_HZ = 200
SHOWN = 15
PLACE = ROOT / "runs"
OURS = "pancakes"
IMPORTS = "(modules that are imported)"


def profile(topic: str, command: Sequence[str]) -> Path:
    """Runs a command under py-spy, and returns the file with its profile.

    Args:
        topic: names the file.
        command: measures the topic; it is run by this Python.

    Raises:
        PeerMissing: py-spy could not be installed.
        RuntimeError: it may not look at processes here, or the command failed.
    """
    spy = python_of(PYSPY).with_name("py-spy")
    PLACE.mkdir(exist_ok=True)
    file = PLACE / f"profile-{topic}.folded"
    file.unlink(missing_ok=True)
    options = ["--subprocesses", "--gil", "--threads", "--function", "--rate", str(RATE_HZ), "--format", "raw"]
    ended = subprocess.run([str(spy), "record", *options, "--output", str(file), "--", sys.executable, *command])
    if not file.is_file():
        raise RuntimeError(f"py-spy has written nothing, and ended with {ended.returncode}")
    return file


def summary(lines: Iterable[str]) -> list[str]:
    """Returns the functions of Pancakes in which most time was spent, as text.

    Args:
        lines: of a profile: the functions of a stack from the outermost on, between `;`, and how often it was seen.
    """
    itself: Counter[str] = Counter()
    whole: Counter[str] = Counter()
    seen = 0
    for line in lines:
        stack, _, count = line.rpartition(" ")
        frames = [frame for frame in stack.split(";") if frame.endswith(")")]
        of_ours = [frame for frame in frames if f"({OURS}/" in frame or f"/{OURS}/" in frame]
        if not of_ours:
            continue  # the benchmark itself, or what is bare
        if any(frame.startswith("<module> ") for frame in of_ours):
            of_ours = [IMPORTS]  # one line for all of a start; the file has them all
        seen += int(count)
        itself[of_ours[-1]] += int(count)
        for frame in set(of_ours):
            whole[frame] += int(count)
    if not seen:
        return ["there is nothing of Pancakes in it"]
    told = ["by itself, with what it calls that is not Pancakes' own; with all that it calls"]
    for frame, times in itself.most_common(SHOWN):
        told.append(f"{times / seen:6.1%} {whole[frame] / seen:6.1%}  {frame}")
    return told
