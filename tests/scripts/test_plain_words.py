"""Comments, docstrings, messages and guides name the thing: the thread, the queue, the subscriber."""

from __future__ import annotations

import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
VAGUE = re.compile(r"\b(whoever|(no|some|any|every)body|(some|any|every)one)\b", re.IGNORECASE)
TEXTS = (tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING))


def vague_words(source: str) -> Iterator[tuple[int, str]]:
    """Yields each vague word in a comment or a string, with its line."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type in TEXTS:
            for match in VAGUE.finditer(token.string):
                yield token.start[0] + token.string.count("\n", 0, match.start()), match.group()


def guides() -> list[Path]:
    """Returns the texts that are no Python: guides, configurations, templates, and the scripts of the page."""
    roots = [ROOT / name for name in ("docs", "configs", "pancakes", "plugins")]
    kinds = (".md", ".toml", ".in", ".js", ".html", ".css")
    files = [path for root in roots for path in sorted(root.rglob("*")) if path.suffix in kinds]
    return [ROOT / "README.md", ROOT / "CHANGELOG.md", *files]


def test_vague_words_are_found_in_texts_and_nowhere_else() -> None:
    source = '"""Text.\n\nNobody waits.\n"""\nx = f"{y} to whoever"  # anyone reads\nnobody = "nobodys"\n'
    assert list(vague_words(source)) == [(3, "Nobody"), (5, "whoever"), (5, "anyone")]


def test_no_text_of_the_product_is_vague() -> None:
    files = [path for folder in ("pancakes", "plugins", "scripts") for path in sorted((ROOT / folder).rglob("*.py"))]
    places = {path.relative_to(ROOT): path.read_text() for path in files}
    found = [f"{path}:{line}: {word}" for path, source in places.items() for line, word in vague_words(source)]
    assert len(files) > 400 and found == []


def test_no_guide_is_vague() -> None:
    files = guides()
    lines = [(path, number, line) for path in files for number, line in enumerate(path.read_text().splitlines(), 1)]
    found = [f"{path.relative_to(ROOT)}:{number}: {line}" for path, number, line in lines if VAGUE.search(line)]
    assert len(files) > 80 and found == []
