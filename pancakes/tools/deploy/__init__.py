"""Deploy a fleet: copy its wheels and configurations to its hosts, and switch its agents to them."""
