"""An agent in this process, with the tasks of a benchmark, as its user would configure it."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any

from benchmarks.agent_process import INSECURE

from pancakes.agent.agent import Agent
from pancakes.config import parse
from pancakes.task import Task
from pancakes.util.plugins import Plugins

READY_S = 30.0


@contextmanager
def local_agent(
    classes: Mapping[str, type[Task]],
    tasks: Mapping[str, str],
    channels: Sequence[str] = (),
    offers: Mapping[tuple[str, str], Any] = MappingProxyType({}),
    more: str = "",
) -> Iterator[Agent]:
    """Runs an agent.

    Args:
        classes: the task classes, by the name of their type.
        tasks: the tables of the tasks, as TOML, by their names.
        channels: channels of its own.
        offers: other plug-ins, by group and name.
        more: other tables, as TOML.
    """
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as directory:
        lines = [
            "schema = 1",
            "[agent]",
            f'name = "bench-{os.getpid()}"',  # two benchmarks may run on one machine, and meet at `local://NAME`
            'listen = "tcp://127.0.0.1:0"',
            f'state_dir = "{directory}/state"',
            "[service.log]",
            "settings = { console = false }",
            *(f"[channel.{channel}]" for channel in channels),
            *(f"[task.{name}]\n{table}" for name, table in tasks.items()),
            more,
            INSECURE,
        ]
        plugins = Plugins({("pancakes.tasks", name): cls for name, cls in classes.items()} | dict(offers))
        agent = Agent(parse("\n".join(lines), "bench.toml"), plugins)
        agent.start()
        try:
            if not agent.ready.wait(READY_S):
                raise TimeoutError(f"the agent was not ready within {READY_S:g} s")
            yield agent
        finally:
            agent.stop()
