"""Wrappers that shape commands on their way to the actuators."""
