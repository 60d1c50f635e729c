"""A file stays short enough to be read in one go."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MOST_LINES = 500


@pytest.mark.parametrize(("folder", "at_least"), [("pancakes", 300), ("plugins", 40), ("scripts", 4), ("tests", 100)])
def test_no_file_is_long(folder: str, at_least: int) -> None:
    files = list((ROOT / folder).rglob("*.py"))
    lengths = {str(path.relative_to(ROOT)): len(path.read_text().splitlines()) for path in files}
    assert len(lengths) >= at_least
    assert {path: lines for path, lines in lengths.items() if lines > MOST_LINES} == {}
