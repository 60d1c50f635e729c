"""The site of the documentation: links, navigation, and that each name of the public API is on a page of it."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

import pancakes

ROOT = Path(__file__).resolve().parents[2]
LIB = ROOT / "scripts" / "lib"


@pytest.fixture(scope="module")
def docs_links() -> ModuleType:
    sys.path.insert(0, str(LIB))
    try:
        return importlib.import_module("docs_links")
    finally:
        sys.path.remove(str(LIB))


@pytest.fixture
def links(docs_links, tmp_path):
    for name in ("README.md", "LICENSE", "docs/time.md", "docs/how-to/fly.md", "plugins/wings/README.md", "tests/a.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    return docs_links.Links(tmp_path)


@pytest.mark.parametrize(
    ("page", "link", "there"),
    [
        ("time.md", "../README.md", "index.md"),
        ("time.md", "how-to/fly.md", "how-to/fly.md"),
        ("time.md", "../plugins/wings/README.md#fast", "plugins/wings.md#fast"),
        ("time.md", "../plugins/wings", "plugins/wings.md"),
        ("time.md", "../tests/a.py", "source/tests/a.py.txt"),
        ("time.md", "../tests/b.py", "../tests/b.py"),
        ("time.md", "https://example.org/a.md", "https://example.org/a.md"),
        ("time.md", "#clocks", "#clocks"),
        ("index.md", "docs/time.md", "time.md"),
        ("index.md", "LICENSE", "license.md"),
        ("plugins/wings.md", "../../docs/time.md", "../time.md"),
        ("how-to/fly.md", "../time.md", "../time.md"),
    ],
)
def test_link_leads_to_its_place_in_the_site(links, page: str, link: str, there: str):
    assert links.rewritten(f"a [b]({link}) c", page, lambda *_: None) == f"a [b]({there}) c"


def test_link_to_a_test_brings_its_file(links, tmp_path):
    found: list[tuple[str, Path]] = []
    links.rewritten("[a](../tests/a.py)", "time.md", lambda *it: found.append(it))
    assert found == [("source/tests/a.py.txt", tmp_path / "tests" / "a.py")]


def test_link_in_code_stays(links):
    text = "`[a](../README.md)`\n\n```md\n[a](../README.md)\n```\n"
    assert links.rewritten(text, "time.md", lambda *_: None) == text


@pytest.mark.parametrize(
    ("head", "title"),
    [
        ("```python", "```python"),
        ("```python a/b.py", '```python title="a/b.py"'),
        ("```sh background", '```sh title="in a terminal of its own"'),
        ("  ```text output", '  ```text title="prints"'),
    ],
)
def test_block_has_its_file_as_title(links, head: str, title: str):
    assert links.rewritten(f"{head}\nx y\n```\n", "time.md", lambda *_: None) == f"{title}\nx y\n```\n"


def test_block_that_is_shown_as_text_is_found(docs_links):
    assert docs_links.left_over("<p>```python a.py x</p>") and not docs_links.left_over("<code>```</code>")


def test_picture_in_html_is_found(links):
    text = '<img alt="x" src="docs/time.md">'
    assert links.rewritten(text, "index.md", lambda *_: None) == '<img alt="x" src="time.md">'


def test_navigation_has_the_how_to_pages(docs_links):
    nav = [{"Learn": ["a.md"]}, {"Guides": [{"Run": ["b.md"]}, {"Examples": ["how-to/*"]}]}]
    guides = docs_links.expanded(nav, ["how-to/fly.md"])[1]["Guides"]
    assert guides == [{"Run": ["b.md"]}, {"Examples": ["how-to/fly.md"]}]
    assert docs_links.expanded(nav, [])[1]["Guides"] == [{"Run": ["b.md"]}]


def test_page_that_loads_from_another_host_is_found(docs_links):
    assert docs_links.loaded_from_elsewhere('<script async src="https://a.example/b.js"></script>')
    assert docs_links.loaded_from_elsewhere('<link href="https://a.example/b.css" rel="stylesheet">')
    assert docs_links.loaded_from_elsewhere('<link rel="stylesheet" href="https://a.example/b.css">')
    assert docs_links.loaded_from_elsewhere('<a href="https://a.example">a</a><img src="b.svg">') == []


def test_reference_has_each_public_name():
    """`from pancakes import NAME`: each is described on a page of docs/api."""
    pages = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs" / "api").glob("*.md"))
    described = set(re.findall(r"^::: pancakes\.(\w+)$", pages, flags=re.MULTILINE))
    errors = set(re.findall(r"\w+Error", pages))
    public = set(re.findall(r"import (\w+) as \1$", Path(pancakes.__file__).read_text(), flags=re.MULTILINE))
    assert public and public - described - errors == set()
