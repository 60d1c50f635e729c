"""`~` at the beginning of a path is a home folder, in every table."""

from dataclasses import dataclass, field
from pathlib import Path

import pytest

from pancakes.config import parse
from pancakes.config.state_dir import state_dir_of
from pancakes.errors import ConfigError
from pancakes.kernel.kernel import Folders
from pancakes.recording.settings import RecordingSettings
from pancakes.settings import FilePath, change_settings, check_settings, make_settings
from pancakes.task import Task
from pancakes.testing import Fleet
from pancakes.tools.launch.fleet_file import make_fleet
from pancakes.util.files import NoHome, at_home
from pancakes.util.plugins import Plugins

HEAD = 'schema = 1\n[agent]\nname = "a"\n'


@dataclass
class Row:
    file: FilePath = ""


@dataclass
class Plain:
    title: str = "~"
    path: FilePath = "~/usual.csv"
    more: tuple[FilePath, ...] = ()
    rows: dict[str, Row] = field(default_factory=dict)


@pytest.fixture(autouse=True)
def home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


def test_each_path_among_settings_is_a_whole_one(home: Path) -> None:
    given = {"title": "~/no path", "more": ["~/x", "y~", "/z"], "rows": {"r": {"file": "~"}}}
    made = make_settings(Plain, given)
    assert made == Plain("~/no path", f"{home}/usual.csv", (f"{home}/x", "y~", "/z"), {"r": Row(str(home))})
    assert make_settings(Plain, {}) == Plain(path=f"{home}/usual.csv")
    assert change_settings(made, {"path": "~/other.csv"}).path == f"{home}/other.csv"
    assert given["more"] == ["~/x", "y~", "/z"], "what was given stays as it was"


def test_the_agents_own_folders_are_at_home(home: Path) -> None:
    text = HEAD + 'state_dir = "~/robot"\nfolders = ["~/data"]\n[record]\npath = "~/runs/{agent}.mcap"\n'
    config = parse(text, "a.toml")
    assert state_dir_of(config) == home / "robot"
    assert make_settings(RecordingSettings, {"path": "~/x.mcap"}).path == f"{home}/x.mcap"
    folders = Folders("a", config.agent.folders)
    assert folders.refusal_of(Plain, {"path": "~/data/x.csv"}) == ""
    assert folders.refusal_of(Plain, {"path": f"{home}/data/x.csv"}) == ""
    assert "lies outside" in folders.refusal_of(Plain, {"path": "~/.ssh/authorized_keys"})


def test_a_home_of_which_nobody_knows_is_a_fault() -> None:
    with pytest.raises(ConfigError, match=r"^a\.toml:4: \[agent\] state_dir: nothing says where ~nobody-of-that-name"):
        parse(HEAD + 'state_dir = "~nobody-of-that-name/robot"\n', "a.toml")
    (problem,) = check_settings(Plain, {"rows": {"r": {"file": "~nobody-of-that-name"}}})
    assert problem.path == ("rows", "r", "file")
    with pytest.raises(NoHome, match=r"nothing says where ~nobody-of-that-name is: write the whole path"):
        at_home("~/x", "nobody-of-that-name")


@pytest.mark.parametrize("path", ["$HOME/robot", "${HOME}/robot", "/srv/$USER", "runs/x-${ROBOT_1}.mcap"])
def test_a_variable_in_a_path_is_a_fault_and_no_folder(path: str) -> None:
    text = (
        f"{HEAD}state_dir = '{path}'\nfolders = ['{path}']\n[record]\npath = '{path}'\n[service.network.settings]\n"
        f"keys = '{path}'\n[service.log.settings]\nfile = '{path}'\n"
    )
    with pytest.raises(ConfigError) as raised:
        parse(text, "a.toml", plugins=Plugins())
    assert [it.key for it in raised.value.faults] == [
        "[agent] state_dir",
        "[agent] folders[0]",
        "[record] path",
        "[service.network] settings.keys",
        "[service.log] settings.file",
    ]
    said = "there is no variable" if "{" in path else "is not expanded: write `~`"
    assert all(said in it.problem for it in raised.value.faults)


def test_a_dollar_that_begins_no_variable_is_part_of_a_path() -> None:
    assert at_home("/srv/100$/a$-b.csv") == "/srv/100$/a$-b.csv"


def test_a_variable_in_a_fleet_file_is_a_fault(tmp_path: Path) -> None:
    file = tmp_path / "fleet.toml"
    file.write_text('schema = 1\n[fleet]\n[agent.a]\nconfig = "$HOME/a.toml"\n')
    with pytest.raises(ConfigError, match=r"fleet\.toml:4: \[agent\.a\] config: has \$HOME in it"):
        make_fleet([file], (), None, None)


class Notes(Task):
    Settings = Plain

    def on_start(self) -> None:
        self.event("path", path=self.settings.path)


def test_a_task_gets_whole_paths(home: Path) -> None:
    with Fleet(1) as fleet:
        agent = fleet.start("a", tasks={"Notes": {"type": Notes, "settings": {"path": "~/notes.csv"}}})
        fleet.run_for(0.1)
        assert agent.events("path", path=f"{home}/notes.csv")
