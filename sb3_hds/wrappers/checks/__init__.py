"""Checks of a task before anything is learned on it."""
