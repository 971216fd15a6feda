"""What fleet.toml can be written from the logs themselves: which topic is which sensor, what its numbers mean."""
