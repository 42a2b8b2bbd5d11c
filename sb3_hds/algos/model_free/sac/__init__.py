"""Soft actor-critic (SAC) and the algorithms that extend it."""
