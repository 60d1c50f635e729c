"""Malformed answers of a host: each becomes an error with a sentence."""

import sys

import pytest

from pancakes.errors import PancakesError
from pancakes.tools.launch.remote_hosts import HostLook
from pancakes.tools.launch.ssh import LONGEST_LINE, VARIABLE, HostLink

DEEP = "[" * 100_000

SAYS = """
import json, re, sys
number, size = re.search(r"[(](0x[0-9a-f]+)[)].to_bytes[(]([0-9]+)[)]", sys.argv[-1]).groups()
begun = int(number, 16).to_bytes(int(size))
sys.stdout.buffer.write(begun)
sys.stdout.buffer.flush()
sys.stdin.buffer.readline()
answer = open({answer!r}, "rb").read().replace(b"MARK", begun.partition(b"{{}}")[0].lstrip())
for line in sys.stdin:
    sys.stdout.buffer.write(answer.replace(b"NUMBER", str(json.loads(line)["id"]).encode()))
    sys.stdout.buffer.flush()
"""


@pytest.fixture
def host(tmp_path, monkeypatch):
    """Make a connection to a host that answers so; NUMBER stands for that of the request, MARK for the marker."""
    links = []

    def make(answer: str) -> HostLink:
        (tmp_path / "answer").write_text(answer)
        (tmp_path / "says.py").write_text(SAYS.format(answer=str(tmp_path / "answer")))
        monkeypatch.setenv(VARIABLE, f"{sys.executable} {tmp_path / 'says.py'}")
        links.append(HostLink("robot1"))
        return links[-1]

    yield make
    for link in links:
        link.close(0.0)


@pytest.mark.parametrize(
    ("answer", "sentence"),
    [
        ('MARK{"id": "one"}\n', "robot1 sends an answer that is not Pancakes' (Expected `int`, got `str` - at `$.id`)"),
        ('MARK{"id": NUMBER, "fault": [1]}\n', "robot1 sends an answer that is not Pancakes'"),
        (
            'MARK{"id": NUMBER, "result": 5}\n',
            "the answer of robot1 to 'look' cannot be read: Expected `object`, got `int`",
        ),
        ('MARK{"id": NUMBER}\n', "the answer of robot1 to 'look' cannot be read: Expected `object`, got `null`"),
        ('MARK{"id": NUMBER, "result": {"user": "pi"}}\n', "the answer of robot1 to 'look' cannot be read"),
        (f"MARK{DEEP}\n", "robot1 sends an answer that is not Pancakes'"),
        ("x" * (LONGEST_LINE + 1), "robot1 sends an answer that is not Pancakes' (a line of more than 16 MiB)"),
    ],
    ids=["number", "fault", "result", "none", "part", "deep", "line"],
)
def test_malformed_answer_of_a_host_is_an_error(host, answer, sentence):
    with pytest.raises(PancakesError) as error:
        host(answer).obtain("look", 10.0, HostLook, fleet_of={})
    assert sentence in str(error.value)


def test_output_of_the_shell_is_ignored(host):
    shell = "\n".join(["Welcome", DEEP, "9" * 100_000, '"text"', "[1, 2]", "{broken"])
    answer = '{"id": NUMBER, "result": ["wheel"]}'
    assert host(f"{shell}\n{answer.replace('wheel', 'lie')}\nand MARK{answer}\n").obtain(
        "missing", 10.0, list[str]
    ) == ["wheel"]
