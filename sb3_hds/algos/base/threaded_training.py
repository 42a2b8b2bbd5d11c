"""Training in a separate thread, beside a control loop that must not wait."""

import threading

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm


class TrainBeside(BaseCallback):
    """
    Train an off-policy algorithm in another thread while its environment runs.

    The latest policy acts. Construct the algorithm with ``gradient_steps=0``, so that it does not
    train in the loop, too. Once the replay buffer is full, a transition that is sampled while it is
    overwritten may mix two transitions: choose a ``buffer_size`` that is not reached. This is for
    the model-free algorithms of this package and of SBX, which replace all weights at once; those
    of SB3 change them in place.

    :param gradient_steps: gradient steps per call of ``train``
    :param most: largest number of gradient steps per transition; None: no limit
    :raises ValueError: if the algorithm trains in the loop, or has no replay buffer
    """

    def __init__(self, gradient_steps: int = 10, most: float | None = None) -> None:
        super().__init__()
        self.gradient_steps, self.most = gradient_steps, most
        self.n_done = 0
        self._thread: threading.Thread | None = None
        self._stopped = threading.Event()
        self._error: BaseException | None = None

    def _on_training_start(self) -> None:
        model = self.model
        if not isinstance(model, OffPolicyAlgorithm) or model.gradient_steps != 0:
            raise ValueError(
                "TrainBeside trains off-policy algorithms that do not train in the loop: construct "
                f"{type(model).__name__} with gradient_steps=0."
            )
        self._stopped.clear()
        self._thread = threading.Thread(target=self._train, args=(model,), daemon=True)
        self._thread.start()

    def _on_step(self) -> bool:
        if self._error is not None:
            raise self._error
        return True

    def _on_training_end(self) -> None:
        self.stop()
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        """End the thread, as ``learn`` does at its end; call it after an interrupted ``learn``."""
        self._stopped.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _train(self, model: OffPolicyAlgorithm) -> None:
        try:
            while not self._stopped.is_set():
                if self._may_train(model):
                    model.train(gradient_steps=self.gradient_steps, batch_size=model.batch_size)
                    self.n_done += self.gradient_steps
                else:
                    self._stopped.wait(0.001)
        except BaseException as error:
            self._error = error

    def _may_train(self, model: OffPolicyAlgorithm) -> bool:
        assert model.replay_buffer is not None
        n_steps = model.num_timesteps
        enough = n_steps > model.learning_starts and model.replay_buffer.size() > 0
        return enough and (self.most is None or self.n_done < self.most * n_steps)
