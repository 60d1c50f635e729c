"""The tools for people: the command line, fleets, demos, the page, recordings."""
