"""The bounds that docs/architecture.md tells, for tests that compare them with those of the code."""

from __future__ import annotations

import re
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs" / "architecture.md"


def told(sentence: str) -> tuple[float, ...]:
    """Returns the numbers in a sentence of the docs; `sentence` is a pattern with a group for each of them."""
    found = re.search(sentence, " ".join(DOCS.read_text(encoding="utf-8").split()))
    assert found is not None, sentence
    return tuple(map(float, found.groups()))
