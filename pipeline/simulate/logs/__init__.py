"""Conversion of measurements to messages, and of messages to logs."""
