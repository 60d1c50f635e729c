"""What stands before each line where the journal of systemd reads standard error."""

import os

import pytest

from pancakes.services import log


@pytest.fixture
def journal(monkeypatch):
    status = os.fstat(2)
    monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
    log.leads_to_journal.cache_clear()
    yield
    log.leads_to_journal.cache_clear()


@pytest.mark.parametrize(
    ("level", "number"), [("debug", 7), ("info", 6), ("warning", 4), ("error", 3), ("a level of another version", 6)]
)
def test_each_line_has_the_number_that_syslog_has_for_its_level(level, number, journal):
    text = "the motor is hot\nsince 3 s"
    assert log.for_standard_error(text, level) == f"<{number}>the motor is hot\n<{number}>since 3 s"


def test_for_a_person_the_text_is_as_it_is(monkeypatch):
    monkeypatch.delenv("JOURNAL_STREAM", raising=False)
    log.leads_to_journal.cache_clear()
    assert log.for_standard_error("hot", "error") == "hot"
