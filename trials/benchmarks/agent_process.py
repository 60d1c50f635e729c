"""Agents as processes of their own: `pancakes-agent` with a file, as anybody starts it.

The tasks of the benchmarks come by entry point, like everybody's: a distribution of a few lines is put where the
agents' Python looks for distributions.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).resolve().parents[2]
PYTHON_PATH = (str(_ROOT / "trials"), str(_ROOT / "tests"), str(_ROOT))
"""Where started processes import from. The root is for a clone that borrows the environment of another."""
TASKS = {"bench.Near": "benchmarks.mesh_tasks:Near", "bench.Far": "benchmarks.mesh_tasks:Far",
         "bench.Started": "benchmarks.idle_tasks:Started", "bench.Idle": "benchmarks.idle_tasks:Idle",
         "bench.Steady": "benchmarks.steady:Steady", "bench.Busy": "benchmarks.lateness:Busy",
         "bench.Periodic": "benchmarks.lateness:Periodic", "bench.Judge": "benchmarks.lateness:Judge",
         "bench.Small": "benchmarks.many_tasks:Small", "bench.Kept": "benchmarks.guarded:Kept",
         "bench.Member": "benchmarks.mesh_tasks:Member"}  # fmt: skip
PACKETS = {"bench": "benchmarks.mesh_tasks"}
INSECURE = """
[service.network]
settings = { insecure = true }
"""
"""What the file of each agent says that speaks over TCP: what is bare beside it encrypts nothing either."""
PATIENCE_S = 60.0
PATIENCE_TO_END_S = 10.0


def offer_tasks(
    directory: Path, tasks: Mapping[str, str] = TASKS, packets: Mapping[str, str] = PACKETS
) -> Mapping[str, str]:
    """Makes the distribution in `directory`; returns the environment of a process that finds it.

    Args:
        directory: where it is put.
        tasks: the task types that it offers.
        packets: the modules of packet types that it offers; each agent imports all of these at its start.
    """
    info = directory / "pancakes_bench-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: pancakes-bench\nVersion: 1\n")
    lines = ["[pancakes.tasks]", *(f"{name} = {value}" for name, value in tasks.items())]
    lines += ["[pancakes.services]", "bench.Crowd = benchmarks.many_tasks:Crowd"]
    lines += ["[pancakes.packets]", *(f"{name} = {value}" for name, value in packets.items())]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    runtime = directory / "run"
    runtime.mkdir(mode=0o700)
    return {
        **usual_environment(),
        "PYTHONPATH": os.pathsep.join((str(directory), *PYTHON_PATH)),
        "PANCAKES_RUNTIME_DIR": str(runtime),
    }


def keys_of(directory: Path, *names: str) -> Mapping[str, str]:
    """Makes keys for agents; returns what is to be in the environment of their processes."""
    from keys_in_test import KeysInTest  # it imports cryptography, which no agent that imports this needs

    keys = KeysInTest(directory)
    for name in names:
        keys.of_agent("default", name)
    return keys.environment


def head_of(name: str, directory: Path, peers: Sequence[str] = (), at: str = "tcp://127.0.0.1:0") -> str:
    """Returns how the configuration of an agent begins: it listens anywhere, and shows nothing.

    Args:
        name: the agent's name.
        directory: its state goes into a directory in here.
        peers: addresses that it dials.
        at: where it listens.
    """
    return f"""
schema = 1
[agent]
name = "{name}"
listen = "{at}"
peers = {json.dumps(list(peers))}
state_dir = "{directory}/state-{name}"
[service.log]
settings = {{ console = false }}
{INSECURE}"""


def usual_environment() -> dict[str, str]:
    """Returns this process's environment, in which Python keeps what it has compiled, as it does by itself."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


@contextmanager
def agent_process(
    config: str,
    directory: Path,
    environment: Mapping[str, str],
    core: int | None = None,
    pass_fds: tuple[int, ...] = (),
    until_ready: bool = False,
    python: str | Path = sys.executable,
) -> Iterator[subprocess.Popen[bytes]]:
    """Runs `pancakes-agent`.

    Args:
        config: its configuration, as TOML.
        directory: where the file is written to.
        environment: see `offer_tasks`.
        core: the processor core that it is bound to, if any.
        pass_fds: file descriptors that it inherits.
        until_ready: wait until all runs that it is to start with: it listens then, and has its entry.
        python: of the environment from which it is started.
    """
    path = directory / f"agent{time.monotonic_ns()}.toml"
    path.write_text(config)
    command = [str(Path(python).with_name("pancakes-agent")), "--config", str(path)]
    if not until_ready:
        with process(command, environment, core, pass_fds) as started:
            yield started
        return
    with ready_process(command, environment, core, pass_fds) as started:
        yield started


@contextmanager
def ready_process(
    command: list[str], environment: Mapping[str, str], core: int | None = None, pass_fds: tuple[int, ...] = ()
) -> Iterator[subprocess.Popen[bytes]]:
    """Runs `pancakes-agent` from this command, and waits until all runs that it is to start with; see `process`."""
    reader, writer = os.pipe()
    command = [*command, "--ready-fd", str(writer)]
    with open(reader, "rb"), process(command, environment, core, (*pass_fds, writer)) as started:
        os.close(writer)
        _read_line(reader)
        yield started


@contextmanager
def process(
    command: list[str], environment: Mapping[str, str], core: int | None = None, pass_fds: tuple[int, ...] = ()
) -> Iterator[subprocess.Popen[bytes]]:
    """Runs a process, and ends it."""
    bind = None if core is None else lambda: os.sched_setaffinity(0, {core})
    # In a process group of its own: Ctrl-C is for the benchmark alone, which ends it in good order.
    started = subprocess.Popen(
        command, env=dict(environment), stdin=subprocess.PIPE, pass_fds=pass_fds, preexec_fn=bind, process_group=0
    )
    try:
        yield started
    finally:
        end([started])


def end(processes: Sequence[subprocess.Popen[Any]]) -> None:
    """Ends processes all at once, whether or not they do as they are asked."""
    running = [it for it in processes if it.poll() is None]
    for it in running:
        it.terminate()
    for it in processes:
        try:
            it.communicate(timeout=PATIENCE_TO_END_S)
        except subprocess.TimeoutExpired:
            it.kill()
            it.communicate()


def listening_at(environment: Mapping[str, str], name: str, started: subprocess.Popen[Any], local: bool = False) -> str:
    """Returns where an agent that is ready listens: from its entry, by which the command line finds it as well.

    Args:
        environment: that of its process.
        name: its name.
        started: its process.
        local: whether at its `local://`; else over TCP.
    """
    entry = Path(environment["PANCAKES_RUNTIME_DIR"]) / f"{name}.{started.pid}.json"
    listen: list[str] = json.loads(entry.read_text())["listen"]
    return listen[0 if local else -1]


def two_cores() -> tuple[int, int] | tuple[None, None]:
    """Returns two cores to bind two processes to; none where there are no two."""
    if not hasattr(os, "sched_getaffinity"):
        return None, None
    cores = sorted(os.sched_getaffinity(0))
    return (cores[0], cores[1]) if len(cores) > 1 else (None, None)


def read_report(reader: int, patience_s: float = PATIENCE_S) -> Any:
    """Waits for the line of JSON that a process writes into a pipe."""
    return json.loads(_read_line(reader, patience_s))


def _read_line(reader: int, patience_s: float = PATIENCE_S) -> bytes:
    import select

    text = b""
    until_s = time.monotonic() + patience_s
    while not text.endswith(b"\n"):
        if not select.select([reader], [], [], max(0.0, until_s - time.monotonic()))[0]:
            raise TimeoutError(f"nothing was reported within {patience_s:g} s")
        part = os.read(reader, 65_536)
        if not part:
            raise RuntimeError("a process ended before it had reported anything")
        text += part
    return text
