"""What runs an agent: its kernel, its services, the lives of its tasks, its configuration and its records on disk."""
