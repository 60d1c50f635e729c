"""What stands for hardware: devices, the simulated world, energy."""
