"""Which extras of Pancakes the configuration of an agent needs: a deployment brings them."""

from __future__ import annotations

from pancakes.runtime.config import Config
from pancakes.runtime.plugins import Plugins
from pancakes.runtime.transport_settings import keyed_addresses


def needed_extras(config: Config, has_keys: bool, plugins: Plugins) -> list[str]:
    """Returns the extras without which an agent would lack something that its configuration asks for.

    Args:
        config: its configuration.
        has_keys: whether there are keys of it on its host.
        plugins: where its transports are found.
    """
    network = config.services.get("network")
    settings = network.settings if network is not None else {}
    named = bool(settings.get("keys"))
    keyed = bool(keyed_addresses(config.agent, plugins)) and not settings.get("insecure")
    needed = {
        "keys": has_keys or named or keyed,  # with keys but without this extra it takes no revocation
        "metrics": any(service.type == "metrics" for service in config.services.values()),
        "record": config.record is not None,
    }
    return [extra for extra, is_needed in needed.items() if is_needed]
