"""Resampling of the rows of a log to a constant interval, with a report of the changes."""
