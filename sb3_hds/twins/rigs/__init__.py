"""Twins of machines on a bench, one file each."""
