"""How programs that are no agents reach agents: the command line, the page, a script of one's own."""

from pancakes.client.mesh_client import Client
from pancakes.client.where import Where

__all__ = ["Client", "Where"]
