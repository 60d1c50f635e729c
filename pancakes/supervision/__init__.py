"""Supervision: the lives of tasks and services, restart policies, slots, and the messages between them."""
