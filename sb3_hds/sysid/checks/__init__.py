"""Checks of a log and a model: conventions, timing, adequacy."""
