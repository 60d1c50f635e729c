"""Demos: whole missions that run by one command, live or in virtual time, and are judged at the end."""

from pancakes.demo.demo import Demo, Run

__all__ = ["Demo", "Run"]
