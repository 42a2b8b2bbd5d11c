"""
Experiments over several seeds, with paired initial states and confidence intervals.

Names are imported on first use.
"""

from sb3_hds.lazy import lazy_imports

with lazy_imports(__name__):
    from sb3_hds.experiments.policy_gain import PolicyGain, measure_policy_gain
    from sb3_hds.experiments.returns import returns_of
    from sb3_hds.experiments.robustness import PERTURBATIONS, Robustness, measure_robustness

__all__ = [
    "PERTURBATIONS",
    "PolicyGain",
    "Robustness",
    "measure_policy_gain",
    "measure_robustness",
    "returns_of",
]
