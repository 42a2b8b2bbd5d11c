"""From measured data to a verdict: the stages in order, and what is named."""
