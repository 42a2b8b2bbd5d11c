"""
Measured effects of a change: several seeds, paired start states, confidence intervals.

Names are imported on first use.
"""

from typing import TYPE_CHECKING

from sb3_hds.lazy import lazily

if TYPE_CHECKING:
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

lazily(
    __name__,
    {
        "PERTURBATIONS": "sb3_hds.experiments.robustness",
        "PolicyGain": "sb3_hds.experiments.policy_gain",
        "Robustness": "sb3_hds.experiments.robustness",
        "measure_policy_gain": "sb3_hds.experiments.policy_gain",
        "measure_robustness": "sb3_hds.experiments.robustness",
        "returns_of": "sb3_hds.experiments.returns",
    },
)
