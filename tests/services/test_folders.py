"""Files are written at the word of another below those folders alone that the agent's configuration names."""

import os
from dataclasses import dataclass, field

import pytest

from pancakes.control import Configure, Migrate, Start
from pancakes.devices.driver import Sensor
from pancakes.kernel.kernel import Folders
from pancakes.settings import FilePath, paths_in
from pancakes.task import Task
from pancakes.testing import Fleet


@dataclass
class Legs:
    log: FilePath = ""
    length_m: float = 1.0


class Writer(Task):
    @dataclass
    class Settings:
        path: FilePath = "usual.csv"
        more: tuple[FilePath, ...] = ()
        legs: Legs = field(default_factory=Legs)
        by_name: dict[str, FilePath] = field(default_factory=dict)
        text: str = ""
        perhaps: FilePath | None = None
        one_or_more: FilePath | list[FilePath] = ""


class Gauge(Sensor):
    type = "pose"

    @dataclass
    class Settings:
        path: FilePath = ""

    def read(self):
        return None


def test_paths_are_found_wherever_they_stand():
    plain = {
        "path": "a",
        "more": ["b", "c"],
        "legs": {"log": "d", "length_m": 2.0},
        "by_name": {"x": "e"},
        "text": "no path",
        "perhaps": "f",
        "one_or_more": ["g"],
        "other": {"path": "unknown"},
    }
    assert list(paths_in(Writer.Settings, plain)) == [
        (("path",), "a"),
        (("more", 0), "b"),
        (("more", 1), "c"),
        (("legs", "log"), "d"),
        (("by_name", "x"), "e"),
        (("perhaps",), "f"),
        (("one_or_more", 0), "g"),
    ]
    assert list(paths_in(Writer.Settings, {"perhaps": None, "one_or_more": "h"})) == [(("one_or_more",), "h")]


@pytest.mark.parametrize(
    ("path", "may"),
    [
        ("{tmp}/runs/x.csv", True),
        ("{tmp}/runs/deep/{agent}.csv", True),
        ("{tmp}/of-a/x.csv", True),
        ("{tmp}/logs/a.jsonl", True),
        ("{tmp}/logs/b.jsonl", False),
        ("bare.csv", True),
        ("usual.csv", True),
        ("", True),
        ("{tmp}/runs", False),
        ("{tmp}/runs-of-another/x.csv", False),
        ("{tmp}/runs/../x.csv", False),
        ("{tmp}/runs/link/x.csv", False),
        ("{tmp}/x.csv", False),
        ("other.csv", False),
        ("/etc/cron.d/x", False),
        ("runs/\0", False),
    ],
)
def test_a_path_lies_below_a_folder_that_is_named_or_is_the_file_that_is_named(tmp_path, path, may):
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "link").symlink_to(tmp_path)
    files = ("", f"{tmp_path}/logs/a.jsonl", "bare.csv")
    folders = Folders("a", (f"{tmp_path}/runs", f"{tmp_path}/of-{{agent}}"), files[1:])
    for settings in (
        {"path": path.replace("{tmp}", str(tmp_path))},
        {"legs": {"log": path.replace("{tmp}", str(tmp_path))}},
    ):
        is_usual_of_another_key = path == "usual.csv" and "path" not in settings
        assert (folders.refusal_of(Writer.Settings, settings) == "") is (may and not is_usual_of_another_key)


@pytest.fixture
def fleet():
    with Fleet(seed=2, classes={"test.Writer": Writer}) as made:
        yield made


def refusal(key, path, folders):
    names = ", ".join(os.path.realpath(folder) for folder in folders) or "none"
    return (
        f"{key}: {path!r} lies outside of the folders that the configuration of a names ({names}):"
        " add its folder to folders in [agent] there"
    )


def test_no_command_has_a_file_written_elsewhere(fleet, tmp_path):
    """Neither the log file, nor the recorder's, nor that of a task or a driver."""
    agent = fleet.start(
        "a",
        folders=("runs",),
        tasks={"Writer": Writer, "Rests": {"type": Writer, "start": False}},
        devices={"pose": {"type": Gauge, "settings": {"path": f"{tmp_path}/gauge"}}},
        services={"log": {"type": "log", "settings": {"console": False, "file": f"{tmp_path}/log/a.jsonl"}}},
    )
    for command, name, key in (
        (Start("log/Recorder", {"path": "/etc/x.mcap"}), "Recorder", "path"),
        (Configure("log/File", {"path": "/etc/x.mcap"}), "File", "path"),
        (Configure("Writer", {"more": ["runs/good", "/etc/x.mcap"]}), "Writer", "more[1]"),
        (Configure("Writer", {"path": "/etc/x.mcap"}, dry_run=True), "Writer", "path"),
        (Start("Rests", {"path": "/etc/x.mcap"}), "Rests", "path"),
        (Configure("device/pose", {"path": "/etc/x.mcap"}), "pose", "path"),
    ):
        reply = agent.ask(command)
        assert not reply.ok
        assert reply.reason == f"bad settings for {name}: " + refusal(key, "/etc/x.mcap", ["runs"])
    assert agent.ask(Configure("Writer", {"path": "runs/good"})).ok


def test_a_task_that_comes_with_a_path_elsewhere_is_declined(fleet):
    a = fleet.start("a", tasks={"Writer": {"type": Writer, "settings": {"path": "/srv/a/x.csv"}}, "Usual": Writer})
    b = fleet.start("b", folders=("runs",))
    fleet.connect()
    reply = a.ask(Migrate("Writer"))
    assert (
        not reply.ok
        and "path: '/srv/a/x.csv' lies outside of the folders that the configuration of b names" in reply.reason
    )
    assert a.running() == ["Writer", "Usual"]
    assert a.ask(Migrate("Usual")).ok, "what its class has as its default is the word of no other"
    assert b.running() == ["Usual"]


def test_a_class_that_raises_anything_where_nothing_is_set_has_no_usual_paths(tmp_path):
    @dataclass
    class Settings:
        path: FilePath = ""

        def __post_init__(self) -> None:
            if not self.path:
                raise KeyError("path")

    folders = Folders("a", [str(tmp_path)])
    assert folders.refusal_of(Settings, {"path": str(tmp_path / "x")}) == ""
    assert "lies outside of the folders" in folders.refusal_of(Settings, {"path": "/elsewhere"})
