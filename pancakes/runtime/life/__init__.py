"""The life of what an agent keeps running: a task, a service, a process of a fleet. Pure."""
