"""The simulated world (`sim.*`): robots, physics, sensors, drivers. `pancakes.simulation` runs a fleet in it."""
