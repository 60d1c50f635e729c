"""What tests of MQTT need: a broker that no one here wrote."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from mqtt.brokers import Mosquitto


@pytest.fixture
def mosquitto(tmp_path: Path) -> Iterator[Callable[..., Mosquitto]]:
    """Starts a mosquitto with these lines in its configuration. Each test with a broker comes through here."""
    started: list[Mosquitto] = []

    def start(*lines: str) -> Mosquitto:
        started.append(Mosquitto(tmp_path / "mosquitto", *lines))
        started[-1].start()
        return started[-1]

    yield start
    for broker in started:
        broker.end()


@pytest.fixture
def broker(mosquitto: Callable[..., Mosquitto]) -> Mosquitto:
    """A mosquitto that takes anybody."""
    return mosquitto()
