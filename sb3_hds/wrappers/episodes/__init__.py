"""Wrappers that set when an episode ends, and how the next one begins."""
