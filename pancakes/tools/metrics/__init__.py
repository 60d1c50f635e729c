"""The metrics of an agent for Prometheus."""
