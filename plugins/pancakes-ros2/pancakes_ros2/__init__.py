"""ROS 2 for Pancakes: robots that are ROS 2 nodes as bodies for tasks, and an agent as nodes, topics and services."""

__version__ = "0.1.0"
