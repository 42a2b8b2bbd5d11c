"""Makes the stock ``rl_zoo3`` command know the algorithms and environments of ``sb3_hds``."""
