"""What people use: the command line, fleets, demos, the page, recordings."""
