"""Hooks of mkdocs for the site (`scripts/docs`): pages from outside of docs/, links between them, and diagrams.

mermaid, which draws the diagrams, comes from a distribution of the extra `docs`, because the site must not load
anything from another host; `on_post_build` looks for that.
"""

from __future__ import annotations

import importlib.util
import posixpath
import re
from pathlib import Path

from docs_links import Links, expanded, left_over, loaded_from_elsewhere
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.plugins import get_plugin_logger
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from mkdocs.utils import get_relative_url

ROOT = Path(__file__).resolve().parents[2]
MERMAID = "assets/mermaid.js"
_GUIDE = re.compile(r"\bdocs/([\w/-]+\.md)\b(?![^<]*</(?:code|a)>)")

log = get_plugin_logger("pancakes")
links = Links(ROOT)


def on_config(config: MkDocsConfig) -> None:
    """Replace the entry for all how-to pages of the navigation by what is in their folder."""
    config.nav = expanded(config.nav, links.how_to())


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages from outside of docs/, and the program that draws the diagrams."""
    for path, page in links.pages.items():
        if path == "LICENSE":
            files.append(File.generated(config, page, content=licence((ROOT / path).read_text(encoding="utf-8"))))
        else:
            files.append(File.generated(config, page, abs_src_path=str(ROOT / path)))
    files.append(File.generated(config, MERMAID, abs_src_path=str(mermaid())))
    return files


def licence(text: str) -> str:
    """Return the licence as a page."""
    return f"# Licence\n\n```text\n{text}```\n"


def mermaid() -> Path:
    """Return the path of mermaid's program."""
    found = importlib.util.find_spec("mermaidx")
    for folder in (found.submodule_search_locations or ()) if found else ():
        path = Path(folder) / "assets" / "mermaid.js"
        if path.is_file():
            return path
    raise PluginError("mermaid.js was not found in the distribution mermaidx, which the extra `docs` installs")


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Make links to files of the repository lead to their places in the site."""
    if page.file.src_uri == "index.md":
        page.meta["hide"] = ["navigation"]  # the README is no page of a group

    def found(place: str, path: Path) -> None:
        if files.get_file_from_path(place) is None:
            files.append(File.generated(config, place, abs_src_path=str(path)))

    return links.rewritten(markdown, page.file.src_uri, found)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Link the guides that docstrings name by their files, as in `(docs/testing.md)`."""

    def linked(match: re.Match[str]) -> str:
        file = files.get_file_from_path(match[1])
        if file is None or file.page is None:
            log.warning(f"a docstring on {page.file.src_uri} names docs/{match[1]}, which does not exist")
            return match[0]
        return f'<a href="{get_relative_url(file.url, page.url)}">{file.page.title}</a>'

    return _GUIDE.sub(linked, html) if page.file.src_uri.startswith("api/") else html


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Load mermaid on the pages that have diagrams: it is large."""
    if '<pre class="mermaid">' not in output:
        return output
    up = posixpath.relpath(MERMAID, page.url.rpartition("/")[0] or ".")
    return output.replace("</head>", f'<script src="{up}"></script></head>', 1)


def on_post_build(config: MkDocsConfig) -> None:
    """Warn of pages that load something from another host, or show a block as text."""
    for path in sorted(Path(config.site_dir).rglob("*.html")):
        html, name = path.read_text(encoding="utf-8"), path.relative_to(config.site_dir)
        for tag in loaded_from_elsewhere(html):
            log.warning(f"{name} loads from another host: {tag}")
        if left_over(html):
            log.warning(f"{name} has a block of code whose beginning is not understood")
