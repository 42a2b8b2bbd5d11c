"""What a change is worth, measured: several seeds, the same start states, intervals."""

from sb3_hds.experiments.policy_gain import PolicyGain, measure_policy_gain

__all__ = ["PolicyGain", "measure_policy_gain"]
