"""How a trial of ``rl_zoo3 train -optimize`` shows that it goes on."""

import time

from stable_baselines3.common.callbacks import BaseCallback

from rl_zoo_plugin.trials import budget

# Between two lines. [s]
_EVERY = 10.0


class TrialProgress(BaseCallback):
    """Prints a line now and then that says how far the trial is."""

    def __init__(self) -> None:
        super().__init__()
        now = budget()
        self.name = "Trial" if now is None else f"Trial {now.trial}"
        self._begin = self._said = 0.0

    def _on_training_start(self) -> None:
        self._begin = time.monotonic()
        self._say(f"0 of {self.locals['total_timesteps']} steps")

    def _on_step(self) -> bool:
        if time.monotonic() - self._said > _EVERY:
            planning = self.locals.get("pretraining", False)
            steps = f"{self.num_timesteps} of {self.locals['total_timesteps']} steps"
            self._say("planning before the first step" if planning else steps)
        return True

    def _say(self, what: str) -> None:
        self._said = time.monotonic()
        print(f"{self.name}: {what} after {self._said - self._begin:.0f} s", flush=True)
