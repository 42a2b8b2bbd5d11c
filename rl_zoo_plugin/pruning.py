"""Evaluations by which Optuna prunes trials, also before their first real step."""

from typing import Any

from rl_zoo3.callbacks import TrialEvalCallback


class TrialEvaluations(TrialEvalCallback):
    """
    The zoo's callback, which also evaluates algorithms that plan before the first real step: as
    often during the planning epochs as during the steps after them. Evaluations of the former are
    steps 1 to n of the trial, those of the latter n + 1 and up, also where the pretraining ended
    early, so that trials are compared at the same moments.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._every = self._n_planned = 0

    def _on_training_start(self) -> None:
        super()._on_training_start()
        due = getattr(self.model, "pretraining_due", 0)
        n_calls = self.locals["total_timesteps"] // self.training_env.num_envs
        self._every = max(1, due * self.eval_freq // max(n_calls, 1))
        self._n_planned = due // self._every

    def _on_step(self) -> bool:
        if not self.locals.get("pretraining"):
            self.eval_idx = max(self.eval_idx, self._n_planned)
            return super()._on_step()
        steps_between, self.eval_freq = self.eval_freq, self._every
        try:
            return super()._on_step()
        finally:
            self.eval_freq = steps_between
