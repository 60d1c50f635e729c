"""What an agent does and costs, as Prometheus reads it."""
