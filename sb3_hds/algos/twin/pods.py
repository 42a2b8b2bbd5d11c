"""Policy optimisation through differentiable simulation."""

from sb3_hds.algos.base.config import takes
from sb3_hds.algos.twin.algorithm import TwinAlgorithm
from sb3_hds.algos.twin.config import PODSConfig


class PODS(TwinAlgorithm):
    """
    Policy optimisation through differentiable simulation.

    In each epoch, roll the policy out in the twin from many start states, improve each *sequence of
    actions* by first- or second-order steps with a line search in the simulator, and regress the
    policy on the states of the improved trajectories. No plan is ever worse than its start.

    The defaults differ from the paper, because full episodes planned from scratch get stuck on
    swing-ups: short horizons with a learned terminal value, random warm starts, start states that
    continue from epoch to epoch, weighted regression. Arguments restore the paper's settings::

        PODS(env, planner="gauss_newton", horizon=100, n_iterations=1, n_random_plans=0,
             lookahead=0, terminal_value=False, reset_share=1.0, plan_memory=1, loss="squared",
             gain_weight=0.0, sensitivity_weight=0.0, averaging=0.0, adapt_scales=False,
             learned_share=1.0, compare_every=0, least_gain=0.0, gamma=1.0, gradient_steps=50,
             policy_kwargs={"linear_path": False})

    Paper: Mora, Peychev, Ha, Vechev, Coros, *PODS: Policy Optimization via Differentiable
    Simulation*, ICML 2021, PMLR 139:7805-7817.
    """

    config_class = PODSConfig

    @takes(PODSConfig)
    def __init__(self, config: PODSConfig) -> None:
        self.construct(config)
