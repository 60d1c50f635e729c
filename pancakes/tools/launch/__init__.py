"""Launch a fleet: which agents run, on which host, in which order, and what happens when one ends."""
