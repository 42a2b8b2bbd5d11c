"""Wrappers that keep commands and states within limits."""
