"""The extras that a deployment adds by itself."""

from __future__ import annotations

from pathlib import Path

import pytest

from pancakes.config import load
from pancakes.tools.deploy.plan import needed_extras
from pancakes.util.plugins import Plugins

LISTENS = 'listen = "tcp://127.0.0.1:0"\n'


@pytest.mark.parametrize(
    ("text", "has_keys", "expected"),
    [
        ("", False, []),
        (LISTENS, False, ["keys"]),
        ('peers = ["tcp://127.0.0.1:7401"]\n', False, ["keys"]),
        ("[service.network]\nsettings = { insecure = true }\n", True, ["keys"]),
        (LISTENS + "[service.network]\nsettings = { insecure = true }\n", False, []),
        ('[service.network]\nsettings = { keys = "/tmp/keys" }\n', False, ["keys"]),
        ("[record]\nstart = false\n", False, ["record"]),
        ('[service.figures]\ntype = "metrics"\n', False, ["metrics"]),
    ],
)
def test_extras_follow_from_the_configuration(tmp_path: Path, text: str, has_keys: bool, expected: list[str]):
    path = tmp_path / "a.toml"
    path.write_text(f'schema = 1\n[agent]\nname = "a"\n{text}')
    assert needed_extras(load(path, (), None), has_keys, Plugins()) == expected
