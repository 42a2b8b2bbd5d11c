"""Wrappers for a real machine: its clock, its log, and pushes."""
