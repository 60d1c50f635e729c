"""An agent for other machines, whose host name resolves to its own loopback address, as on Debian."""

import sys

import pytest
from cli.processes import INSECURE, PATIENCE_S, Rig, Running
from harness.hosts_file import may_have_hosts, with_hosts
from harness.programs import AGENT, PANCAKES, run

pytestmark = pytest.mark.skipif(not may_have_hosts(), reason="no namespace of one's own may be made here")


def test_name_of_the_loopback_is_reported(rig: Rig):
    enter = with_hosts(rig.directory, {"robot1": "127.0.1.1"})
    path = rig.config("a", INSECURE)
    path.write_text(path.read_text().replace("127.0.0.1:0", "robot1:0"))

    checked = run(
        [*enter, sys.executable, "-m", PANCAKES, "config", "check", str(path)],
        timeout_s=PATIENCE_S,
        env=rig.environment,
        cwd=rig.directory,
    )
    assert checked.returncode == 0
    assert "a.toml:6: [agent] listen: only this machine reaches it at tcp://robot1:0" in checked.stderr

    agent = Running([*enter, sys.executable, "-m", AGENT, "--config", str(path)], rig.environment, rig.directory)
    try:
        told = agent.hear("is not reached from other machines")
        assert "warning" in told and "robot1 is 127.0.1.1 here" in told
        findings = rig.pancakes("doctor").stdout
        assert "is not reached from other machines: only this machine reaches it at tcp://robot1:0" in findings
    finally:
        agent.close()


def test_reachable_and_local_addresses_are_not_reported(rig: Rig):
    path = rig.config("a", INSECURE)
    assert "only this machine" not in rig.pancakes("config", "check", str(path)).stderr
    path.write_text(path.read_text().replace("127.0.0.1:0", "0.0.0.0:0"))
    assert "only this machine" not in rig.pancakes("config", "check", str(path)).stderr
