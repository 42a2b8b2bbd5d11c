"""Planning epochs before the first real step."""

from typing import TYPE_CHECKING

from stable_baselines3.common.callbacks import BaseCallback

if TYPE_CHECKING:
    from sb3_hds.algos.twin_algorithm import TwinAlgorithm

# Log lines written during pretraining.
_N_LOGS = 10


class Pretraining(BaseCallback):
    """
    Runs the planning epochs that are due when training starts, so that everything SB3 sets up for
    ``learn`` (logger, other callbacks, environment) is there. Interrupted, it leaves a model that
    goes on where it stopped.

    :param progress_bar: whether to show one
    """

    def __init__(self, progress_bar: bool) -> None:
        super().__init__()
        self.progress_bar = progress_bar

    def _on_training_start(self) -> None:
        model: TwinAlgorithm = self.model  # type: ignore[assignment]
        model.before_planning()
        due = model.pretraining_due
        every = max(1, due // _N_LOGS)
        for i in self._shown(range(1, due + 1)):
            model.pretrain_epoch()
            done = not model.pretraining_due
            if done or i % every == 0:
                model.logger.dump(step=model.num_timesteps)
            if done:
                break

    def _on_step(self) -> bool:
        """SB3 stores a step after the callbacks have seen it, checkpoints among them."""
        model: TwinAlgorithm = self.model  # type: ignore[assignment]
        names = ("buffer_actions", "new_obs", "rewards", "dones", "infos")
        model.unstored_step = {name: self.locals[name] for name in names}
        return True

    def _shown(self, epochs: range):
        if not (self.progress_bar and epochs):
            return epochs
        from rich.progress import track

        return track(epochs, description="planning in the twin")
