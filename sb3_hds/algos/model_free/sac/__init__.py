"""Soft actor-critic and its relatives."""
