"""How a service keeps tasks: it starts, watches, stops and restarts them, and answers what it is asked."""
