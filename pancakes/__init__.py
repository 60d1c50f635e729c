"""Pancakes: robots and sensor nodes that work as one (see README.md)."""

__version__ = "0.1.0"
