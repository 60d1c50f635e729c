"""Durable tasks: checkpoints, migration, guardians and take-over, and reliable delivery to tasks that move."""
