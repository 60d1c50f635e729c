"""The page: what a fleet does, in a browser. A client of the fleet shows it, so that no agent is held up by it."""
