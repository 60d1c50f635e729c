"""How an error reads that nobody foresaw: in one line, with the line of the user's own code."""

import importlib
import json
import re
import sys
from pathlib import Path

import pytest

from pancakes.devices.builtin_drivers import HostProcessorLoad
from pancakes.errors import LONGEST_TRACEBACK, PancakesError, describe, traceback_of
from pancakes.task import Task

HERE = Path(__file__).name


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Makes modules that lie where pip installs them, or among a user's own files."""
    made = []

    def make(name, source, installed):
        root = tmp_path / ("lib/python3/site-packages" if installed else "mine")
        root.mkdir(parents=True, exist_ok=True)
        monkeypatch.syspath_prepend(str(root))
        (root / f"{name}.py").write_text(source)
        importlib.invalidate_caches()
        made.append(name)
        return importlib.import_module(name)

    yield make
    for name in made:
        sys.modules.pop(name, None)


def raised(function, *arguments):
    """Returns the error that a function raises, without this line of its way."""
    try:
        function(*arguments)
    except BaseException as error:
        assert error.__traceback__ is not None
        return error.with_traceback(error.__traceback__.tb_next)
    raise AssertionError("it raised nothing")


def line_of(text):
    """Returns the number of the only line of this file that ends with a comment."""
    (found,) = [n for n, line in enumerate(Path(__file__).read_text().splitlines(), 1) if line.endswith(f"# {text}")]
    return found


class Mine(Task):
    def parse(self):
        json.loads("{")  # parses

    def lead(self):
        try:
            dict[str, str]()["x"]
        except KeyError as error:
            raise ValueError("bad colour") from error  # from

    def follow(self):
        try:
            dict[str, str]()["x"]
        except KeyError:
            raise ValueError("bad colour")  # while

    def forget(self):
        try:
            dict[str, str]()["x"]
        except KeyError:
            raise ValueError("bad colour") from None  # alone

    def refuse(self):
        raise PancakesError("the port is\nin use")  # refuses

    def wrapped(self):
        try:
            Mine.parse(self)
        except ValueError as error:
            raise RuntimeError("no plan") from error


def test_it_shows_the_line_of_the_user_and_not_the_librarys():
    error = raised(Mine.parse, None)
    assert describe(error, Mine).endswith(f" (char 1) at {HERE}:{line_of('parses')} in parse")
    assert describe(error) == describe(error, Mine)


@pytest.mark.parametrize(
    ("method", "said"),
    [
        ("lead", "ValueError: bad colour (from KeyError: 'x') at {here}:{from} in lead"),
        ("follow", "ValueError: bad colour (from KeyError: 'x') at {here}:{while} in follow"),
        ("forget", "ValueError: bad colour at {here}:{alone} in forget"),
        ("refuse", "the port is in use at {here}:{refuses} in refuse"),
    ],
)
def test_the_chain_is_in_one_line(method, said):
    places = {name: line_of(name) for name in ("from", "while", "alone", "refuses")}
    assert describe(raised(getattr(Mine, method), None), Mine) == said.format(here=HERE, **places)


def test_a_chain_is_told_to_five_errors_and_a_circle_once():
    error = ValueError("0")
    last: Exception = error
    for number in range(1, 8):
        cause = RuntimeError(str(number))
        last.__cause__, last = cause, cause
    said = describe(error)
    assert said.startswith("ValueError: 0 (from RuntimeError: 1, ") and said.endswith("from RuntimeError: 4, ...)")
    one, other = KeyError("one"), KeyError("other")
    one.__cause__, other.__cause__ = other, one
    assert describe(one) == "KeyError: 'one' (from KeyError: 'other')"


PLUGIN = """
import plainlib
from pancakes.task import Task

class Blink(Task):
    def on_tick(self):
        plainlib.parse("red")
"""
LIBRARY = """
def parse(text):
    raise ValueError(f"bad colour {text}")
"""
ASKS = """
import plugged

class Slow(plugged.Blink):
    pass

def ask():
    plugged.Blink.on_tick(None)
"""


def test_of_a_plug_in_that_is_installed_its_own_line_counts(module):
    module("plainlib", LIBRARY, installed=True)
    plugged = module("plugged", PLUGIN, installed=True)
    error = raised(plugged.Blink.on_tick, None)
    assert describe(error, plugged.Blink) == "ValueError: bad colour red at plugged.py:7 in on_tick"


def test_of_a_class_that_adds_nothing_the_line_of_the_class_that_it_inherits_from_counts(module):
    module("plainlib", LIBRARY, installed=True)
    plugged = module("plugged", PLUGIN, installed=True)
    asks = module("asks", ASKS, installed=True)
    error = raised(plugged.Blink.on_tick, None)
    assert describe(error, asks.Slow) == "ValueError: bad colour red at plugged.py:7 in on_tick"
    # A user's own file is the user's, whatever the class is of.
    sys.modules.pop("asks")
    (Path(asks.__file__)).unlink()
    mine = module("asks", ASKS, installed=False)
    assert describe(raised(mine.ask), HostProcessorLoad) == "ValueError: bad colour red at asks.py:8 in ask"


def test_where_no_line_is_the_users_the_innermost_that_is_not_pythons_is_shown(module):
    library = module("plainlib", LIBRARY.replace("raise", "import json; json.loads('{') #"), installed=True)
    assert describe(raised(library.parse, "red"), HostProcessorLoad).endswith(" at plainlib.py:3 in parse")


def test_an_error_that_came_by_no_line_has_none():
    assert describe(ValueError("no")) == "ValueError: no"
    assert describe(KeyboardInterrupt()) == "KeyboardInterrupt"
    assert describe(PancakesError("a sentence.")) == "a sentence."


def test_it_is_one_line_of_bounded_length_whatever_an_error_says():
    class Odd(Exception):
        def __str__(self):
            raise RuntimeError("no text")

    assert describe(ValueError("a\n\n  b")) == "ValueError: a b"
    assert len(describe(ValueError("x" * 10**6))) < 600
    assert describe(Odd()) == "Odd: (its text cannot be shown)"
    assert "Odd" in traceback_of(Odd())


def ping(depth):
    return pong(depth - 1) if depth else 1 / 0


def pong(depth):
    return ping(depth - 1)


def test_a_traceback_is_whole_but_bounded():
    text = traceback_of(raised(Mine.wrapped, None))
    assert text.startswith("Traceback (most recent call last):")
    assert "JSONDecodeError" in text and "direct cause" in text and text.endswith("RuntimeError: no plan")
    deep = traceback_of(raised(ping, 400))
    assert len(deep) <= LONGEST_TRACEBACK and deep.endswith("ZeroDivisionError: division by zero")
    long = traceback_of(ValueError("x" * 10**6 + "end"))
    assert len(long) <= LONGEST_TRACEBACK and long.endswith("end")
    assert re.search(r"\.\.\. [\d,]+ characters were left out \.\.\.", long)
