"""The defaults of services and of restarts are those of docs/reference/configuration.md."""

import json
from collections.abc import Mapping
from pathlib import Path

import pytest
from msgspec.structs import fields

from pancakes.durable.client_service import ClientService
from pancakes.service import Service
from pancakes.services.device import DeviceService
from pancakes.services.log import LogService
from pancakes.services.network import NetworkService
from pancakes.supervision.restart import DeviceRestartSpec, RestartSpec

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "configuration.md"


def documented(heading: str) -> Mapping[str, object]:
    """Returns the defaults below a heading, by key; the tables of a setting's own keys come after the first one."""
    section = PAGE.read_text(encoding="utf-8").partition(f"\n{heading}\n")[2].partition("\n##")[0]
    section = "| `" + section.partition("\n| `")[2].partition("\n\n")[0]
    rows = [line.split(" | ") for line in section.splitlines() if line.startswith("| `")]
    return {row[0].strip("| `"): _default(row[2].strip("`")) for row in rows if len(row) > 2}


def _default(text: str) -> object:
    return None if text == "none" else json.loads(text)


@pytest.mark.parametrize(("name", "cls"), [("log", LogService), ("network", NetworkService), ("client", ClientService)])
def test_settings_of_services_have_documented_defaults(name: str, cls: type[Service]) -> None:
    settings = cls.Settings()
    begun = {field.name: getattr(settings, field.name) for field in fields(cls.Settings)}
    assert documented(f"### `{name}`") == begun != {}


def test_settings_of_the_device_service_are_none() -> None:
    assert documented("### `device`") == {}
    assert vars(DeviceService.Settings()) == {}


@pytest.mark.parametrize(
    ("heading", "cls"),
    [("## `restart = { ... }`", RestartSpec), ("## `[device.NAME] restart = { ... }`", DeviceRestartSpec)],
)
def test_settings_of_restarts_have_documented_defaults(heading: str, cls: type[RestartSpec]) -> None:
    begun = {field.name: getattr(cls(), field.name) for field in fields(cls)}
    assert documented(heading) == begun != {}
