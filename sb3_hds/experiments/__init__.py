"""What a change is worth, measured: several seeds, the same start states, intervals."""

from sb3_hds.experiments.policy_gain import PolicyGain, measure_policy_gain
from sb3_hds.experiments.returns import returns_of

__all__ = ["PolicyGain", "measure_policy_gain", "returns_of"]
