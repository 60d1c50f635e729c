"""Demos: whole missions that one command runs, live or in virtual time, and judges at the end."""

from pancakes.tools.demo.demo import Comparison, Death, Demo, Loss, Run, Variant

__all__ = ["Comparison", "Death", "Demo", "Loss", "Run", "Variant"]
