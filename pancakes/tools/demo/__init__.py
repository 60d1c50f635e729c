"""Demos: whole missions that run by one command, live or in virtual time, and are judged at the end."""

from pancakes.tools.demo.demo import Comparison, Demo, Loss, Run, Variant

__all__ = ["Comparison", "Demo", "Loss", "Run", "Variant"]
