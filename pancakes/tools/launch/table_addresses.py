"""The addresses in an agent's file, and what is to be set there so that it has others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pancakes.mesh.address import Address, parse_address
from pancakes.runtime.config.toml_text import key_text, leaves, value_text


def addresses_in(value: Any) -> list[Address]:
    """Returns the addresses with a port in a table, or in what stands in one, each once."""
    if isinstance(value, str):
        address = _address(value)
        return [address] if address is not None else []
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return list(dict.fromkeys(address for it in inner for address in addresses_in(it)))


def moved(table: Mapping[str, Any], others: Mapping[Address, str]) -> list[str]:
    """Returns what is to be set in an agent's file so that it has other addresses, as `--set` takes it.

    Args:
        table: what the file says.
        others: by address, what stands in its place.
    """
    changed = [(keys, _with(value, others), value) for keys, value in leaves(table)]
    return [f"{key_text(keys)}={value_text(now)}" for keys, now, before in changed if now != before]


def _with(value: Any, others: Mapping[Address, str]) -> Any:
    if isinstance(value, list):
        return [_with(it, others) for it in value]
    address = _address(value) if isinstance(value, str) else None
    return others.get(address, value) if address is not None else value


def _address(text: str) -> Address | None:
    """Returns the address that a text is; None where it is none with a port."""
    try:
        found = parse_address(text)
    except ValueError:
        return None
    return found if found.scheme in ("tcp", "udp") else None
