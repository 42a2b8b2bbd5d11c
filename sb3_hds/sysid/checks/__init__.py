"""Checks of a log and a model: conventions, timing, adequacy, and stability of parameters."""
