"""The experiment of the paper with robots of another release of ROS 2: nothing but topics leads to them."""

import json
import subprocess

import pytest
from ros2.environments import AGENTS, ROBOTS, environment, python_of

SPEED = 4.0
"""Mission seconds a second."""


@pytest.mark.timeout(240)
def test_two_robots_that_are_nodes_alone_pass_the_verdict(domain, tmp_path):
    command = [str(python_of(AGENTS)), "-m", "pancakes.tools.cli.main", "demo", "ros2", "--headless", "--local"]
    theirs = f'world:task.World.settings.python="{python_of(ROBOTS)}"'
    options = ["--speed", str(SPEED), "--out", str(tmp_path / "out"), "--set", theirs]
    done = subprocess.run([*command, *options], env=environment(domain), capture_output=True, text=True, timeout=220)
    assert "verdict: PASS" in done.stdout, done.stdout + done.stderr
    assert done.returncode == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [holder["agent"] for holder in summary["holders"]] == ["agent1", "agent2"]
    assert summary["gap_s"] <= 0.5 and summary["overlap_s"] == 0.0
