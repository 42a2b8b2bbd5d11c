"""Checks of a task before training."""
