"""Off-policy algorithms that learn from transitions."""
