"""How programs that are no agents reach agents: the command line, the page, a script of one's own."""

from pancakes.client.client import Client
from pancakes.client.where import Where

__all__ = ["Client", "Where"]
