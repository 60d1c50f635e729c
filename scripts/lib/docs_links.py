"""Where the site has the files of the repository, and how the links between them read there. Needs only Python.

The pages are written for a git forge, and some of their blocks are marked for `scripts/readme`. Their links lead to
files of the repository. The site has some of these files at other places, and files that are no pages, such as tests,
as plain text. So each link is followed in the repository first. A link to a file that does not exist is left as it is;
mkdocs warns of it.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

DOCS = "docs"
PAGES = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "LICENSE": "license.md",
    "README.md": "index.md",
    "SECURITY.md": "security-policy.md",
}
"""By file of the repository outside of docs/: where the site has it. The READMEs of plug-ins are added."""
HOW_TO = "how-to"
SOURCES = "source"
"""The folder of the site with files of the repository that are no pages."""

_FENCE = re.compile(r"^ {0,3}(`{3,}|~{3,})")
_INFO = re.compile(r"^( {0,3}(?:`{3,}|~{3,})[\w-]+) +(\S.*)$", re.MULTILINE)
_TITLES = {"background": "in a terminal of its own", "output": "prints"}
"""What a mark of `scripts/readme` after the language of a block means to a reader. Any other is the name of a file."""
_CODE = re.compile(r"(`+)(?:.|\n)+?\1")
_LINK = re.compile(
    r"(?<=\]\()(?P<inline>[^)\s]+)(?=\))"
    r"|(?<=^\[)(?P<label>[^\]\s]+\]:\s*)(?P<reference>\S+)"
    r"|(?<=\ssrc=\")(?P<src>[^\"]+)"
    r"|(?<=\ssrcset=\")(?P<srcset>[^\"]+)",
    re.MULTILINE,
)
_ELSEWHERE = re.compile(r"^(?:[a-z][a-z0-9+.-]*:|//|/|#)", re.IGNORECASE)
_FOREIGN = re.compile(
    r"<(?:script|img|iframe|source)\b[^>]*\bsrc(?:set)?=\"?https?:[^\s>]*"
    r"|<link\b(?=[^>]*\brel=\"?(?:stylesheet|preconnect)\b)[^>]*https?:[^\s>]*",
    re.IGNORECASE,
)


class Links:
    """The links of a site.

    Args:
        root: the repository.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        plugins = sorted(path.parent.name for path in (root / "plugins").glob("*/README.md"))
        found = {**PAGES, **{f"plugins/{name}/README.md": f"plugins/{name}.md" for name in plugins}}
        self.pages: Mapping[str, str] = {path: page for path, page in found.items() if (root / path).is_file()}
        """By file of the repository outside of docs/: where the site has it."""

    def how_to(self) -> list[str]:
        """Return the how-to pages, as a navigation names them."""
        return [f"{HOW_TO}/{path.name}" for path in sorted((self._root / DOCS / HOW_TO).glob("*.md"))]

    def rewritten(self, markdown: str, page: str, found: Callable[[str, Path], None]) -> str:
        """Return a page with its links as they read in the site.

        Args:
            markdown: the page, as it is in the repository.
            page: where the site has it.
            found: called with each file that is no page: where the site must have it, and the file.
        """

        def linked(target: str) -> str:
            return self._linked(target, page, found)

        return "".join(titled(part) if is_code else with_links(part, linked) for is_code, part in parts(markdown))

    def _linked(self, target: str, page: str, found: Callable[[str, Path], None]) -> str:
        if _ELSEWHERE.match(target):
            return target
        path, mark, anchor = target.partition("#")
        file = posixpath.normpath(posixpath.join(posixpath.dirname(self._file_of(page)), path))
        place = "" if file.startswith("..") else self._place_of(file)
        if not place:
            return target
        if place.startswith(f"{SOURCES}/"):
            found(place, self._root / file)
        return posixpath.relpath(place, posixpath.dirname(page) or ".") + mark + anchor

    def _file_of(self, page: str) -> str:
        """Return the file of the repository that a page of the site is made from."""
        return next((path for path, place in self.pages.items() if place == page), f"{DOCS}/{page}")

    def _place_of(self, file: str) -> str:
        """Return where the site has a file, or the README of a folder; empty: there is no such file."""
        if (self._root / file).is_dir():
            file = posixpath.join(file, "README.md")
        if not (self._root / file).is_file():
            return ""
        if file in self.pages:
            return self.pages[file]
        return file.removeprefix(f"{DOCS}/") if file.startswith(f"{DOCS}/") else f"{SOURCES}/{file}.txt"


def parts(markdown: str) -> Iterator[tuple[bool, str]]:
    """Cut a text into fenced blocks (true) and the rest."""
    fence, gathered = "", ""
    for line in markdown.splitlines(keepends=True):
        match = _FENCE.match(line)
        if match and not fence:
            yield False, gathered
            fence, gathered = match[1], line
        elif match and match[1].startswith(fence) and not line.strip(" \n`~"):
            yield True, gathered + line
            fence, gathered = "", ""
        else:
            gathered += line
    yield bool(fence), gathered


def titled(block: str) -> str:
    """Return a fenced block whose name, for `scripts/readme`, is its title: `python blink.py`, `sh background`."""
    head, newline, rest = block.partition("\n")
    if (match := _INFO.match(head)) and "=" not in match[2]:
        head = f'{match[1]} title="{_TITLES.get(match[2], match[2])}"'
    return head + newline + rest


def with_links(text: str, linked: Callable[[str], str]) -> str:
    """Return a text with other targets in its links; what is code stays."""
    code = [match.span() for match in _CODE.finditer(text)]

    def replaced(match: re.Match[str]) -> str:
        if any(begin <= match.start() < end for begin, end in code):
            return match[0]
        target = match["inline"] or match["reference"] or match["src"] or match["srcset"]
        return (match["label"] or "") + linked(target)

    return _LINK.sub(replaced, text)


def expanded(nav: Any, how_to: list[str]) -> Any:
    """Return a navigation with the how-to pages in the place of `how-to/*`; a group that is left empty goes."""
    if isinstance(nav, dict):
        return {title: expanded(part, how_to) for title, part in nav.items()}
    if not isinstance(nav, list):
        return nav
    whole: list[Any] = []
    for entry in nav:
        if entry == f"{HOW_TO}/*":
            whole += how_to
        elif (made := expanded(entry, how_to)) and (not isinstance(made, dict) or all(made.values())):
            whole.append(made)
    return whole


def left_over(html: str) -> bool:
    """Return whether a page shows a fence that was not understood."""
    return bool(re.search(r"<p>(?:```|~~~)", html))


def loaded_from_elsewhere(html: str) -> list[str]:
    """Return the tags of a page that load something from another host."""
    return _FOREIGN.findall(html)
