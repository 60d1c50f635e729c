"""Plug-ins: found by entry point, imported when asked for; one bad plug-in harms no other."""

from collections.abc import Callable
from pathlib import Path

import pytest

from pancakes.durable.installed import Installed
from pancakes.errors import PluginError
from pancakes.util.plugins import Plugins, UnknownPluginError

Install = Callable[..., None]

TASKS = "pancakes.tasks"


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Installs a distribution of one module, as pip would leave it on the disk."""
    monkeypatch.syspath_prepend(tmp_path)

    def install(name: str, entry_points: str, source: str = "", module: str = "", version: str = "1.0") -> None:
        information = tmp_path / f"{name.replace('-', '_')}-{version}.dist-info"
        information.mkdir()
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        (information / "entry_points.txt").write_text(entry_points)
        if module:
            (tmp_path / f"{module}.py").write_text(source)

    return install


def test_a_plugin_is_found_by_its_name(install: Install):
    install("walk-tasks", "[pancakes.tasks]\nwalk.Walk = plugin_walk:Walk\n", "class Walk: pass\n", "plugin_walk")
    plugins = Plugins()

    assert "walk.Walk" in plugins.names(TASKS)
    assert plugins.get(TASKS, "walk.Walk").__name__ == "Walk"
    assert plugins.get(TASKS, "walk.Walk") is plugins.get(TASKS, "walk.Walk")
    assert plugins.problems() == []


def test_a_cost_function_is_made_once_and_one_that_cannot_be_made_harms_no_other():
    class Bad:
        def __init__(self) -> None:
            raise SystemExit

    installed = Installed(Plugins({("pancakes.costs", "bad"): Bad, ("pancakes.costs", "far"): list}))
    costs = installed.costs()
    assert costs["far"] == [] and "bad" not in costs
    assert installed.costs()["far"] is costs["far"]


def test_its_version_is_known_without_importing_it(install: Install):
    install("run-tasks", "[pancakes.tasks]\nrun.Run = plugin_run:Run\n", "raise SystemExit\n", "plugin_run", "2.5")

    assert Plugins().version(TASKS, "run.Run") == ("run-tasks", "2.5")


def test_a_name_that_nobody_offers(install: Install):
    install("hop-tasks", "[pancakes.tasks]\nhop.Hop = plugin_hop:Hop\n")
    plugins = Plugins()

    with pytest.raises(UnknownPluginError) as error:
        plugins.get(TASKS, "hop.Hopp")
    assert str(error.value) == "unknown task type 'hop.Hopp', did you mean 'hop.Hop'?"

    with pytest.raises(UnknownPluginError) as error:
        plugins.version(TASKS, "swim.Crawl")
    assert str(error.value) == "unknown task type 'swim.Crawl': no installed distribution provides tasks under 'swim.'"


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("import no_such_module\n", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("raise RuntimeError('first\\n  second')\n", "RuntimeError: first second"),
        ("class Other: pass\n", "AttributeError: module 'plugin_bad' has no attribute 'Bad'"),
        ("import sys\nsys.exit(3)\n", "SystemExit: 3"),
        ("def broken(:\n", "SyntaxError: "),
    ],
)
def test_one_that_fails_to_import_is_named_and_the_others_work(
    install: Install, monkeypatch: pytest.MonkeyPatch, source: str, reason: str
):
    import sys

    monkeypatch.delitem(sys.modules, "plugin_bad", raising=False)
    install("bad-tasks", "[pancakes.tasks]\nbad.Bad = plugin_bad:Bad\n", source, "plugin_bad")
    install("good-tasks", "[pancakes.tasks]\ngood.Path = pathlib:Path\n")
    plugins = Plugins()

    for _ in range(2):
        with pytest.raises(PluginError) as error:
            plugins.get(TASKS, "bad.Bad")
        sentence = str(error.value)
        assert sentence.startswith("the task type 'bad.Bad' of bad-tasks 1.0 (plugin_bad:Bad) cannot be loaded: ")
        assert reason in sentence
        assert "\n" not in sentence
    assert [str(problem) for problem in plugins.problems()] == [sentence], "once, however often it was asked for"

    assert plugins.get(TASKS, "good.Path") is Path


def test_an_entry_point_that_makes_no_sense(install: Install):
    install("odd-tasks", "[pancakes.tasks]\nodd.Odd = 1 + 1\n")

    with pytest.raises(PluginError, match="'odd.Odd' of odd-tasks 1.0"):
        Plugins().get(TASKS, "odd.Odd")


def test_two_distributions_that_offer_one_name(install: Install):
    install("first-tasks", "[pancakes.tasks]\ntwice.T = pathlib:Path\n")
    install("second-tasks", "[pancakes.tasks]\ntwice.T = pathlib:PurePath\n")
    plugins = Plugins()

    for ask in (plugins.get, plugins.version):
        with pytest.raises(PluginError) as error:
            ask(TASKS, "twice.T")
        assert "the task type 'twice.T' is offered twice, by " in str(error.value)
        assert "first-tasks (pathlib:Path)" in str(error.value)
        assert "second-tasks (pathlib:PurePath)" in str(error.value)


def test_a_distribution_that_is_found_twice_is_one(install: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """As an editable install is: from its own directory, and from site-packages. The first on the path counts."""
    install("again-tasks", "[pancakes.tasks]\nagain.Path = pathlib:PurePath\n", version="1.0")
    first = tmp_path / "first" / "again_tasks-2.0.dist-info"
    first.mkdir(parents=True)
    (first / "METADATA").write_text("Metadata-Version: 2.1\nName: again-tasks\nVersion: 2.0\n")
    (first / "entry_points.txt").write_text("[pancakes.tasks]\nagain.Path = pathlib:Path\n")
    monkeypatch.syspath_prepend(first.parent)

    assert Plugins().get(TASKS, "again.Path") is Path
    assert Plugins().version(TASKS, "again.Path").version == "2.0"


def test_a_distribution_whose_metadata_is_damaged_harms_no_other(install: Install, tmp_path: Path):
    install("fine-tasks", "[pancakes.tasks]\nfine.Path = pathlib:Path\n")
    install("torn-tasks", "")
    (tmp_path / "torn_tasks-1.0.dist-info" / "entry_points.txt").write_bytes(b"[pancakes.tasks]\n\xff\n")
    plugins = Plugins()

    assert plugins.get(TASKS, "fine.Path") is Path
    (problem,) = plugins.problems()
    assert str(problem).startswith(f"the entry points of torn-tasks in {tmp_path} cannot be read: UnicodeDecodeError")


def test_a_group_that_does_not_exist_is_a_mistake_in_our_own_code():
    with pytest.raises(ValueError, match=r"'pancakes.task' is not a group of plug-ins"):
        Plugins().names("pancakes.task")
    with pytest.raises(ValueError, match=r"'task' is not a group of plug-ins"):
        Plugins(extra={("task", "x"): object})


class TestRegisteredInCode:
    """A test, or a program that is no distribution, hands its plug-ins in."""

    def test_they_are_there_beside_the_installed_ones(self, install: Install):
        install("other-tasks", "[pancakes.tasks]\nother.Path = pathlib:Path\n")
        plugins = Plugins(extra={(TASKS, "demo.X"): int})

        assert plugins.get(TASKS, "demo.X") is int
        assert plugins.version(TASKS, "demo.X") == ("", "")
        assert {"demo.X", "other.Path"} <= set(plugins.names(TASKS))

    def test_they_hide_installed_ones(self, install: Install):
        install("hidden-tasks", "[pancakes.tasks]\nhidden.X = pathlib:Path\n")

        assert Plugins(extra={(TASKS, "hidden.X"): int}).get(TASKS, "hidden.X") is int


class TestPackets:
    def test_importing_them_registers_their_types(self, install: Install):
        source = """
from dataclasses import dataclass
from pancakes.packet import packet_type

@packet_type("test_plugin_smell")
@dataclass(frozen=True)
class Smell:
    strength: float
"""
        install("smell-packets", "[pancakes.packets]\nsmell = plugin_smell\n", source, "plugin_smell")
        from pancakes.packet import body_class

        assert body_class("test_plugin_smell") is None
        assert Plugins().load_packets() == []
        smell = body_class("test_plugin_smell")
        assert smell is not None and smell.__name__ == "Smell"

    def test_a_bad_one_is_returned_and_the_rest_is_imported(self, install: Install):
        install("a-packets", "[pancakes.packets]\na = plugin_packets_a\n", "import no_such_thing\n", "plugin_packets_a")
        install("b-packets", "[pancakes.packets]\nb = plugin_packets_b\n", "loaded = True\n", "plugin_packets_b")
        plugins = Plugins()

        (error,) = plugins.load_packets()
        assert "the packet module 'a' of a-packets 1.0" in str(error)
        assert plugins.get("pancakes.packets", "b").loaded
