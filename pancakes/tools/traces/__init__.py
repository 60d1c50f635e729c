"""The traces of an agent for OpenTelemetry."""
