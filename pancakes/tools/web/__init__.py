"""Show what a fleet does in a browser. The page is served by a client of the fleet, so it delays no agent."""
