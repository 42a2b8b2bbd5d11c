"""Wrappers that add to what the policy observes."""
