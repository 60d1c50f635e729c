"""The service managers of deployed agents: systemd and the supervisor of Pancakes. The same tests check both."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import psutil
import pytest
from cli.processes import INSECURE, PATIENCE_S
from deploy.ssh_hosts import BARE, INSTALLED, SshHost, SshHosts, with_sshd
from deploy.user_systemd import RUNTIME, UserSystemd

from pancakes.tools.launch.ssh import HostError, HostLink

pytestmark = with_sshd
AGENT = {"fleet": "yard", "name": "a"}
SOUND = f'schema = 1\n[agent]\nname = "a"\nfleet = "yard"\nlisten = "tcp://127.0.0.1:0"\n{INSECURE}'


class Kept:
    """An agent on a host, and the connection to its service manager."""

    def __init__(self, host: SshHost, kind: str) -> None:
        self.host, self.kind = host, kind
        self.link = HostLink(host.name)
        self.give(SOUND)

    def give(self, config: str) -> None:
        """Have the agent a configuration; it runs in the environment of the tests."""
        folder = self.host.data / "agents" / "yard" / "a"
        version = folder / "versions" / "v"
        version.mkdir(parents=True, exist_ok=True)
        (version / "agent.toml").write_text(config)
        for link, target in ((version / "environment", sys.prefix), (folder / "current", "versions/v")):
            link.unlink(missing_ok=True)
            link.symlink_to(target)

    def ask(self, what: str) -> Any:
        return self.link.obtain(what, 100.0, **AGENT)

    def status(self) -> dict[str, Any]:
        found: dict[str, Any] = self.ask("service")
        return found

    def wait(self, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Wait until the status is as it should be; return it."""
        until_s = time.monotonic() + PATIENCE_S
        while not condition(status := self.status()):
            assert time.monotonic() < until_s, status
            time.sleep(0.05)
        return status

    def again(self) -> None:
        """The person logs out, and in again."""
        self.link.close()
        self.link = HostLink(self.host.name)


@pytest.fixture(params=["supervisor", "systemd"])
def kept(hosts: SshHosts, request: pytest.FixtureRequest) -> Iterator[Kept]:
    variables: dict[str, str] = {}
    manager: UserSystemd | None = None
    if request.param == "systemd":
        home = hosts.folder / "robot" / "home"
        home.mkdir(parents=True)
        manager = UserSystemd(home)
        variables["XDG_RUNTIME_DIR"] = RUNTIME
    made = Kept(hosts.add("robot", f"{INSTALLED}:{BARE}", variables, manager.pid if manager else 0), request.param)
    made.ask("install_service")
    yield made
    if made.link.lost:
        made.link = HostLink(made.host.name)
    made.ask("forget_service")
    made.link.close()
    if manager is not None:
        manager.close()


def test_service_outlives_the_connection(kept: Kept):
    kept.ask("start_service")
    status = kept.status()
    assert (status["manager"], status["state"], status["restarts"]) == (kept.kind, "active", 0)
    assert "agent_command" in " ".join(psutil.Process(status["pid"]).cmdline()) or kept.kind == "systemd"
    kept.ask("start_service")  # it runs already
    kept.again()
    assert kept.status() == status
    kept.ask("stop_service")
    assert (kept.status()["state"], kept.status()["pid"]) == ("inactive", 0)
    assert not psutil.pid_exists(status["pid"])
    kept.ask("stop_service")


def test_service_restarts_only_after_a_failure(kept: Kept):
    kept.ask("start_service")
    first = kept.status()["pid"]
    os.kill(first, signal.SIGKILL)
    status = kept.wait(lambda it: it["state"] == "active" and it["pid"] not in (0, first))
    assert status["restarts"] == 1
    os.kill(status["pid"], signal.SIGTERM)
    kept.wait(lambda it: it["state"] == "inactive" and it["pid"] == 0)
    kept.ask("start_service")
    assert kept.status()["state"] == "active"


def test_agent_that_cannot_run_is_reported(kept: Kept):
    kept.give("schema = 1\n[agent]\nnome = 3\n")
    with pytest.raises(HostError, match="robot does not get a ready: "):
        kept.ask("start_service")
    assert kept.status()["pid"] == 0
    kept.give(SOUND)
    kept.ask("start_service")
    assert kept.status()["state"] == "active"


def test_forgotten_service_leaves_nothing(kept: Kept):
    kept.ask("start_service")
    pid = kept.status()["pid"]
    kept.ask("forget_service")
    assert not psutil.pid_exists(pid)
    assert kept.status()["state"] == "inactive"
    assert not list(kept.host.home.glob("**/*.service")) and not list(kept.host.data.glob("**/supervisor"))
