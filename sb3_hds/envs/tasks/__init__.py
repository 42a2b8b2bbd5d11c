"""Environments that no twin simulates: stand-ins for hardware, and small test tasks."""
