"""Refusals: their codes are documented, and reach the one who asked."""

import re
from pathlib import Path
from typing import get_args

import pytest
from services.counting import Count

from pancakes.control import Configure, Migrate, Migrations, Refusal, Start
from pancakes.errors import (
    ConfigError,
    ControlRefusedError,
    MailboxFullError,
    NoCandidateError,
    PancakesError,
    RefusalCode,
    UnknownChannelError,
    UnreachableError,
)
from pancakes.settings import SettingsError
from pancakes.testing import Fleet

CODES = get_args(RefusalCode)
PAGE = (Path(__file__).parents[1] / "docs" / "refusals.md").read_text(encoding="utf-8")


def test_refusal_codes_are_all_documented():
    assert tuple(re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE)) == CODES == tuple(sorted(CODES))


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (ConfigError([]), "invalid"),
        (SettingsError("T", []), "invalid"),
        (ValueError("-1 is no rate"), "invalid"),
        (UnknownChannelError("no such channel"), "not_found"),
        (MailboxFullError("no room"), "busy"),
        (NoCandidateError("no neighbour takes it"), "unable"),
        (UnreachableError("no answer"), "unable"),
        (ControlRefusedError("it runs already"), "conflict"),
        (PancakesError("it went wrong"), "failed"),
        (KeyError("x"), "failed"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Exception) else None,
)
def test_refusal_of_an_error_has_its_code(error, code):
    assert Refusal.of(error).code == code


def test_refusal_that_is_busy_says_when_to_try_again():
    error = ControlRefusedError("it is being moved already", "busy")
    assert error.retry_after_s is not None and error.retry_after_s > 0
    assert Refusal.of(ControlRefusedError("it is stopped already")).retry_after_s is None


def test_refusal_that_came_back_is_raised_as_it_was():
    sent = Refusal("busy", "it is being moved already", 2.5)
    assert Refusal.of(ControlRefusedError.of(sent)) == sent


def test_refusals_reach_who_asks_with_their_codes():
    with Fleet(5, classes={"test.Count": Count}) as fleet:
        agent = fleet.start("a", tasks={"Count": Count})
        fleet.start("b")
        fleet.connect()
        asked = [Start("Count"), Start("Nobody"), Configure("Count", {"nonsense": 1}), Migrate("Discovery")]
        refusals = [agent.ask(body).refusal for body in asked]

    codes = [refusal.code if refusal is not None else None for refusal in refusals]
    assert codes == ["conflict", "not_found", "invalid", "unsupported"]


def test_refusals_of_neighbours_are_in_the_ledger_with_their_codes():
    with Fleet(5, classes={"test.Count": Count}) as fleet:
        agent = fleet.start("a", tasks={"Count": Count})
        fleet.start("b", tasks={"Count": Count})
        fleet.connect()
        reply = agent.ask(Migrate("Count"))

        assert reply.refusal is not None and reply.refusal.code == "unable"
        (line,) = agent.ask(Migrations()).result[-1]["lines"]
        assert (line["peer"], line["fate"], line["code"]) == ("b", "refused", "conflict")
