"""The networks: encoders, matching, concatenation."""
