"""From the rows of a log to samples at one constant interval, and a report of what was done."""
