"""Comments, docstrings and messages name the thing: the thread, the queue, the subscriber."""

from __future__ import annotations

import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
VAGUE = re.compile(r"\b(whoever|nobody|somebody)\b", re.IGNORECASE)
TEXTS = (tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING))


def vague_words(source: str) -> Iterator[tuple[int, str]]:
    """Yields each vague word in a comment or a string, with its line."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type in TEXTS:
            for match in VAGUE.finditer(token.string):
                yield token.start[0] + token.string.count("\n", 0, match.start()), match.group()


def test_vague_words_are_found_in_texts_and_nowhere_else() -> None:
    source = '"""Text.\n\nNobody waits.\n"""\nx = f"{y} to whoever"  # somebody reads\nnobody = "nobodys"\n'
    assert list(vague_words(source)) == [(3, "Nobody"), (5, "whoever"), (5, "somebody")]


def test_no_text_of_the_product_is_vague() -> None:
    files = [path for folder in ("pancakes", "plugins") for path in sorted((ROOT / folder).rglob("*.py"))]
    places = {path.relative_to(ROOT): path.read_text() for path in files}
    found = [f"{path}:{line}: {word}" for path, source in places.items() for line, word in vague_words(source)]
    assert len(files) > 400 and found == []
