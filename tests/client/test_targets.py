"""Names that a program writes, and requests that are merged: as tables."""

from __future__ import annotations

import pytest

from pancakes.client.client import channel_of, destination_on, task_of
from pancakes.client.rows import TaskInfo
from pancakes.client.session import merged
from pancakes.control import Follow
from pancakes.errors import PancakesError

ROW = TaskInfo(agent="a", service="client", task="Count", type="count.Count", state="running")


@pytest.mark.parametrize(
    ("task", "meant"),
    [("a/Count", ("a", "Count")), ("a/client/Count", ("a", "client/Count")), (ROW, ("a", "client/Count"))],
)
def test_a_task_is_named_by_agent_service_and_name_or_by_its_row(task: str | TaskInfo, meant: tuple[str, str]):
    assert task_of(task) == meant


@pytest.mark.parametrize("task", ["", "a", "/Count", "a/", "a//Count", "a/b/c/d"])
def test_what_names_no_task_is_refused(task: str):
    with pytest.raises(PancakesError, match="names no task: write it as AGENT/TASK or AGENT/SERVICE/TASK"):
        task_of(task)


@pytest.mark.parametrize(("channel", "meant"), [("system", ("", "system")), ("a/system", ("a", "system"))])
def test_a_channel_is_that_of_one_agent_or_of_all(channel: str, meant: tuple[str, str]):
    assert channel_of(channel) == meant


@pytest.mark.parametrize("channel", ["", "/system", "a/", "a/b/system"])
def test_what_names_no_channel_is_refused(channel: str):
    with pytest.raises(PancakesError, match="names no channel: write it as AGENT/CHANNEL"):
        channel_of(channel)


@pytest.mark.parametrize(
    ("to", "address"),
    [("", "a"), ("client", "a/client"), ("client/Count", "a/client/Count"), ("a/client/Count", "a/client/Count")],
)
def test_a_destination_is_on_the_agent(to: str, address: str):
    assert destination_on("a", to) == address


@pytest.mark.parametrize("to", ["*", "task:a/Count", "client/", "b/client/Count/x"])
def test_what_is_no_destination_on_the_agent_is_refused(to: str):
    with pytest.raises(PancakesError, match="is not a service or task of a: write it as SERVICE/TASK"):
        destination_on("a", to)


@pytest.mark.parametrize(
    ("requests", "whole"),
    [
        ([Follow("c", ("x",))], Follow("c", ("x",))),
        ([Follow("c", ("x",)), Follow("c", ("y", "x"))], Follow("c", ("x", "y"))),
        ([Follow("c", ("x",)), Follow("c")], Follow("c")),
        ([Follow("c", include_remote=True), Follow("c")], Follow("c", include_remote=True)),
        ([Follow("c", most_hz=2.0), Follow("c", most_hz=5.0)], Follow("c", most_hz=5.0)),
        ([Follow("c", most_hz=2.0), Follow("c")], Follow("c")),
    ],
)
def test_merged_requests_bring_what_each_brings(requests: list[Follow], whole: Follow):
    assert merged(requests) == whole
