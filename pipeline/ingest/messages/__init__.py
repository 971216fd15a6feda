"""Messages of every kind to plain arrays."""
