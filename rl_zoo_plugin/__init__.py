"""Registers the algorithms and environments of ``sb3_hds`` with the stock ``rl_zoo3`` command."""
