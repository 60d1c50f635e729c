"""An agent, put together from its configuration."""
