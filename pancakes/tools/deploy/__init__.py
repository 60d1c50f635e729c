"""Deployments: a fleet's wheels and configurations are brought to its hosts, and its agents switched to them."""
