"""What is said of links, and how loud."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from pancakes.mesh.link import Over
from pancakes.mesh.links import LinkLog

STATIC = "tcp://10.0.0.9:7400"


@pytest.fixture
def said() -> list[tuple[str, str]]:
    return []


@pytest.fixture
def log(said: list[tuple[str, str]]) -> LinkLog:
    return LinkLog(lambda level, text: said.append((level, text)), [STATIC])


def session(**others: Any) -> Any:
    return SimpleNamespace(
        **{"peer": "b", "link": object(), "role": "agent", "address": "", "remote": "tcp://10.0.0.7:5000", **others}
    )


@pytest.mark.parametrize(
    ("role", "over", "level"),
    [
        ("agent", Over("it left"), "info"),
        ("client", Over("it left"), "debug"),
        ("agent", Over("it broke the protocol", broken=True), "warning"),
        ("client", Over("it broke the protocol", broken=True), "warning"),
        ("client", Over("it gives its place up", refusing="full"), "debug"),
        ("agent", Over("there is no room", refusing="full"), "warning"),
        ("client", Over("of another fleet", refused="fleet"), "warning"),
    ],
)
def test_the_end_of_a_link_is_as_loud_as_it_is_unusual(
    log: LinkLog, said: list[tuple[str, str]], role: str, over: Over, level: str
) -> None:
    log.on_link_ended(session(role=role), over)
    assert said == [(level, f"the link to b has ended: {over.reason}")]


@pytest.mark.parametrize(
    ("address", "over", "level"),
    [
        (STATIC, Over("refused"), "info"),
        ("tcp://10.0.0.8:7400", Over("refused"), "debug"),
        (STATIC, Over("of two links this one goes", refusing="duplicate"), "debug"),
        (STATIC, Over("of another fleet", refused="fleet"), "warning"),
        ("tcp://10.0.0.8:7400", Over("it broke the protocol", broken=True), "warning"),
    ],
)
def test_a_connection_that_becomes_no_link_is_as_loud_as_a_person_counts_on_it(
    log: LinkLog, said: list[tuple[str, str]], address: str, over: Over, level: str
) -> None:
    log.not_made(session(address=address), over, 0.0)
    assert said == [(level, f"no link over {address}: {over.reason}")]


def test_the_same_is_said_once_of_each_of_256_places(log: LinkLog, said: list[tuple[str, str]]) -> None:
    for number in range(256):
        log.not_made(session(address=f"tcp://10.0.1.{number}:1"), Over("refused"), 0.0)
    for number in (0, 255):
        log.not_made(session(address=f"tcp://10.0.1.{number}:1"), Over("refused"), 0.0)
    assert len(said) == 256
    log.not_made(session(address="tcp://10.0.2.1:1"), Over("refused"), 0.0)
    log.not_made(session(address="tcp://10.0.1.0:1"), Over("refused"), 0.0)
    assert len(said) == 258, "places that it has no room for are told anew"


def test_of_strangers_from_one_place_one_is_told_of_each_five_seconds(
    log: LinkLog, said: list[tuple[str, str]]
) -> None:
    for number in range(100):
        log.not_made(session(address="", remote=f"tcp://10.0.0.9:{number}"), Over(f"stranger {number}"), number / 100)
    log.not_made(session(address="", remote="tcp://10.0.0.8:1"), Over("another place"), 1.0)
    log.not_made(session(address="", remote="tcp://10.0.0.9:7"), Over("the last"), 5.0)
    for number in range(59):
        log.not_made(session(address="", remote="tcp://10.0.0.9:7"), Over("the last"), 6.0 + number)
    log.not_made(session(address="", remote="tcp://10.0.0.9:7"), Over("the last"), 65.0)
    assert [text for _, text in said] == [
        "no link over a connection from tcp://10.0.0.9: stranger 0",
        "no link over a connection from tcp://10.0.0.8: another place",
        "no link over a connection from tcp://10.0.0.9: the last (and 99 others, that were not told of)",
        "no link over a connection from tcp://10.0.0.9: the last (and 59 others, that were not told of)",
    ]
