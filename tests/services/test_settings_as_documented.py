"""What a service is set to where nothing is said is what docs/reference/configuration.md says."""

import json
from collections.abc import Mapping
from pathlib import Path

import pytest
from msgspec.structs import fields

from pancakes.runtime.hosting.client import ClientService
from pancakes.runtime.services.device import DeviceService
from pancakes.runtime.services.log import LogService
from pancakes.runtime.services.network import NetworkService
from pancakes.service import Service

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "configuration.md"


def documented(name: str) -> Mapping[str, object]:
    """Returns the defaults of a service, by key."""
    section = PAGE.read_text(encoding="utf-8").partition(f"### `{name}`\n")[2].partition("\n##")[0]
    rows = [line.split(" | ") for line in section.splitlines() if line.startswith("| `")]
    return {row[0].strip("| `"): json.loads(row[2].strip("`")) for row in rows if len(row) > 2}


@pytest.mark.parametrize(("name", "cls"), [("log", LogService), ("network", NetworkService), ("client", ClientService)])
def test_the_defaults_are_the_documented_ones(name: str, cls: type[Service]) -> None:
    settings = cls.Settings()
    begun = {field.name: getattr(settings, field.name) for field in fields(cls.Settings)}
    assert documented(name) == begun != {}


def test_the_device_service_has_no_settings_of_its_own() -> None:
    assert documented("device") == {}
    assert vars(DeviceService.Settings()) == {}
