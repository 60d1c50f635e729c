"""Fleets on one machine: which agents are to run, in which order, and what happens when one ends."""
