"""The rules of a fleet, in a file that its operator can read and change."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import msgspec

from pancakes.errors import PancakesError
from pancakes.mesh.security.key_files import write_private
from pancakes.mesh.security.rules import DEFAULT, EVERY, AccessRule
from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.malformed import MALFORMED
from pancakes.runtime.foundation.plain_file import read_plain
from pancakes.runtime.foundation.toml_values import toml_values
from pancakes.settings import check_settings

RULES: Final = "rules.toml"
_HEAD: Final = """\
# What the members of this fleet may do. What no rule allows is refused; the order does not matter.
# After a change: pancakes fleet sign. The rights, and what they are for, are in docs/security.md.
"""


class _Access(msgspec.Struct, forbid_unknown_fields=True):
    allow: tuple[AccessRule, ...] = ()


class _File(msgspec.Struct, forbid_unknown_fields=True):
    access: _Access


def read_rules(folder: Path) -> tuple[AccessRule, ...]:
    """Reads the rules of a fleet.

    Raises:
        PancakesError: the file cannot be read, or is not sound.
    """
    path = folder / RULES
    try:
        values = toml_values(read_plain(path).decode())
        faults = check_settings(_File, values)
        if not faults:
            return codecs.convert(values, _File).access.allow
    except OSError as error:
        raise PancakesError(f"the rules {path} cannot be read: {error.strerror or error}") from None
    except (*MALFORMED, ValueError) as error:
        raise PancakesError(f"the rules {path} are not sound: {error}") from None
    raise PancakesError(f"the rules {path} are not sound: {'; '.join(map(str, faults))}")


def begin_rules(folder: Path) -> None:
    """Writes the rules of a new fleet."""
    write_private(folder / RULES, (_HEAD + "".join(map(_text, DEFAULT))).encode())


def add_rule(folder: Path, rule: AccessRule) -> None:
    """Adds a rule at the end of the file; what a person wrote there stays.

    Raises:
        PancakesError: the file cannot be read, or is not sound.
    """
    read_rules(folder)
    path = folder / RULES
    write_private(path, read_plain(path).rstrip(b"\n") + b"\n" + _text(rule).encode())


def _text(rule: AccessRule) -> str:
    lines = ["", "[[access.allow]]"]
    for key in ("who", "may", "on", "at"):
        values = getattr(rule, key)
        if key in ("who", "may") or values != (EVERY,):
            lines.append(f"{key} = {_LIST(list(values)).decode()}")
    return "\n".join(lines) + "\n"


_LIST: Final = codecs.json_encoder()
