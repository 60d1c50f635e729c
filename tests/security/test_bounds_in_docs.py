"""The bounds for each peer are what docs/security.md says."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TABLE = (ROOT / "docs/security.md").read_text().partition("## Bounds for each peer")[2].partition("\n## ")[0]
NAMED = re.compile(r"`([a-z_]+)\.([A-Z_]+)`")
ROWS = [line for line in TABLE.splitlines() if NAMED.search(line)]


def defined(module: str, name: str) -> str:
    """Return what a module says that a constant is."""
    said = re.compile(rf"^{name}(?:: Final)? = (.+)$", re.MULTILINE)
    found = [match[1] for path in (ROOT / "pancakes").rglob(f"{module}.py") if (match := said.search(path.read_text()))]
    assert len(found) == 1, f"{module}.{name} is defined {len(found)} times"
    return found[0]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.split("|")[1].strip())
def test_each_bound_has_the_number_that_the_table_names(row):
    told = row.split("|")[2].replace(",", "").replace(";", " ")
    module, name = NAMED.findall(row)[0]
    value = defined(module, name).replace("_", "")
    for number in re.findall(r"\d+", value)[:1] if re.fullmatch(r"[\d.]+|reliable\(\d+\)", value) else ():
        assert number in told.split() or f"{number} " in told, f"{module}.{name} is {value}, and the table says {told}"


def test_the_table_has_a_row_for_each_kind():
    assert len(ROWS) > 25
