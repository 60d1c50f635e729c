"""What tests of MQTT need: a broker that no one here wrote."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from mqtt.brokers import Mosquitto


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    """A mosquitto that runs."""
    found = Mosquitto(tmp_path / "mosquitto")
    found.start()
    yield found
    found.end()
