"""Control characters in texts of agents, plug-ins and strangers are escaped on terminals and in logs."""

from __future__ import annotations

import json
import re
import socket
import tomllib
from pathlib import Path

import msgspec
import pytest
from cli.processes import INSECURE, PATIENCE_S, Rig, Running

from pancakes.mesh.codec import frame
from pancakes.mesh.messages import HELLO_NUMBER, VERSION

OWNED = "\x1b]0;owned\x07 \x9b31m\u202egpj\r\x7f"
"""Sets a terminal's title, colours what follows, turns its direction, and overwrites the line."""
RAW = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")

ENTRY_POINTS = """
[pancakes.tasks]
foul.Mouth = plugin_foul:Mouth
foul.Broken = plugin_foul:Broken
"""
MOUTH = f"""
from msgspec import Struct
from pancakes.packet import packet_type
from pancakes.task import Task, every

OWNED = {OWNED!r}


@packet_type("foul.word")
class Word(Struct, frozen=True):
    text: str


class Mouth(Task):
    class Settings(Struct):
        label: str = OWNED

    class State(Struct):
        words: list[str] = []

    @every(hz=2)
    def speak(self, tick) -> None:
        self.state.words = [OWNED]
        self.log("warning", "said " + OWNED + chr(10) + "    0.000 error   other: forged")
        self.event("foul_" + OWNED, **{{"what" + OWNED: OWNED}})
        self.publish("words", Word(OWNED))


class Broken(Task):
    def on_start(self) -> None:
        raise RuntimeError("broken by " + OWNED)
"""
CONFIG = """
[channel.words]

[task.Mouth]
type = "foul.Mouth"

[task.Broken]
type = "foul.Broken"
restart = { policy = "no" }

[service.log.settings]
file = "a.jsonl"
"""
SHOWN = "\\x1b]0;owned\\x07 \\x9b31m\\u202egpj\\r\\x7f"


@pytest.fixture
def agent(rig: Rig) -> Running:
    rig.install("foul", ENTRY_POINTS, MOUTH)
    agent = rig.ready("a", CONFIG)
    agent.hear("said ")
    assert any("broken by " in line for line in agent.so_far())
    return agent


COMMANDS = (
    ("agent", "list"),
    ("task", "info", "a/Mouth"),
    ("log",),
    ("log", "--format", "json"),
    ("param", "get", "a/Mouth", "label"),
    ("channel", "echo", "a/words", "--count", "1"),
    ("top", "--once"),
    ("doctor",),
)


def test_control_characters_of_a_task_are_shown_escaped(rig: Rig, agent: Running, tmp_path: Path) -> None:
    found = {}
    for command in COMMANDS:
        ended = rig.pancakes(*command)
        said = ended.stdout + ended.stderr
        assert not RAW.search(said), (command, said)
        found[command] = said
    assert SHOWN in found["log",]
    assert SHOWN in found["task", "info", "a/Mouth"]
    (label,) = tomllib.loads(f"label = {found['param', 'get', 'a/Mouth', 'label']}").values()
    assert label == OWNED  # it may be given back to `param set`
    assert "\n    0.000 error   other: forged" not in found["log",]
    records = json.loads(found["log", "--format", "json"])
    assert any(OWNED in str(record.get("text")) for record in records)  # for programs nothing is lost
    shown = "\n".join(agent.so_far())
    assert SHOWN in shown and not RAW.search(shown)
    assert "\n    0.000 error   other: forged" not in shown
    file = (tmp_path / "a.jsonl").read_text()
    assert not RAW.search(file)
    assert any(OWNED in str(json.loads(line).get("text")) for line in file.splitlines())


def answered(port: int, name: str, fleet: str, role: str = "client", listen: str = "") -> str:
    """Send a hello as a stranger; return the reason why the agent refuses the link, or empty if it does not."""
    hello = [HELLO_NUMBER, VERSION, fleet, name, role, "a journal", 0, [listen] if listen else []]
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as link:
        link.sendall(frame([msgspec.msgpack.encode(hello)]))
        data = b""
        while True:
            while len(data) < 4 or len(data) < 4 + int.from_bytes(data[:4], "big"):
                more = link.recv(65_536)
                if not more:
                    return "it closed the link without a word"
                data += more
            length = 4 + int.from_bytes(data[:4], "big")
            for message in msgspec.msgpack.decode(data[4:length]):
                if message[0] == 3:
                    return f"{message[1]}: {message[2]}"
                if message[0] == 2:
                    return ""
            data = data[length:]


def test_control_characters_of_a_stranger_are_refused(rig: Rig) -> None:
    agent = rig.ready("a", INSECURE)
    for name, fleet, role, listen in (
        ("\x1b]0;owned\x07", "test", "client", ""),
        ("b.c", "test", "agent", ""),
        ("bä", "test", "agent", ""),
        ("-b", "test", "agent", ""),
        ("b/c", "test", "agent", ""),
        (".b", "test", "client", ""),
        ("b" * 65, "test", "agent", ""),
        ("b\n", "test", "agent", ""),
        ("", "test", "agent", ""),
        ("b", "te\x1bst", "agent", ""),
        ("b", "test", "agent", "tcp://\x1b]0;owned\x07:1"),
    ):
        reason = answered(rig.port(agent), name, fleet, role, listen)
        wrong = "is no address" if listen else "is not a name: a name has letters from a to z"
        assert reason.startswith("protocol: ") and wrong in reason and not RAW.search(reason), name
    assert answered(rig.port(agent), "b.c-d_1", "test") == "", "a terminal may have a dot in its name"
    assert not RAW.search(agent.hear("is not a name"))
    listed = rig.pancakes("agent", "list")
    assert not RAW.search(listed.stdout + listed.stderr) and "owned" not in listed.stdout
    assert not RAW.search("\n".join(agent.so_far()))
