"""Twins of environments, one file each."""
