"""The experiment of the paper with robots of another release of ROS 2: nothing but topics leads to them."""

import json
import subprocess

from ros2.environments import AGENTS, ROBOTS, environment, python_of

SPEEDS = (4.0, 2.0)
"""Mission seconds a second: the second one where this machine, by the demo's own word, is too slow for the first."""


def test_two_robots_that_are_nodes_alone_pass_the_verdict(domain, tmp_path):
    command = [str(python_of(AGENTS)), "-m", "pancakes.tools.cli.main", "demo", "ros2", "--headless", "--local"]
    theirs = f'world:task.World.settings.python="{python_of(ROBOTS)}"'
    for speed in SPEEDS:
        out = tmp_path / f"{speed:g}"
        options = ["--speed", f"{speed:g}", "--out", str(out), "--set", theirs]
        done = subprocess.run([*command, *options], env=environment(domain), capture_output=True, text=True)
        if done.returncode == 0 or "this machine was too slow" not in done.stdout:
            break
    assert "verdict: PASS" in done.stdout, done.stdout + done.stderr
    assert done.returncode == 0
    summary = json.loads((out / "summary.json").read_text())
    assert [holder["agent"] for holder in summary["holders"]] == ["agent1", "agent2"]
    assert summary["gap_s"] <= 0.5 and summary["overlap_s"] == 0.0
