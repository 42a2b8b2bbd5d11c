"""Updates in plain NumPy; gradients are central differences in every weight."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

Weights = dict[str, Any]
_STEP = 1e-5
_LOG_SQRT_TAU = 0.5 * np.log(2.0 * np.pi)


def slope(loss: Callable[[Weights], float], weights: Weights) -> Weights:
    """:return: by each weight, the derivative of the loss"""

    def of(leaf: np.ndarray) -> np.ndarray:
        found = np.zeros_like(leaf)
        for i in np.ndindex(leaf.shape):
            here, ends = leaf[i], []
            for sign in (1.0, -1.0):
                leaf[i] = here + sign * _STEP
                ends.append(loss(weights))
            leaf[i] = here
            found[i] = (ends[0] - ends[1]) / (2.0 * _STEP)
        return found

    weights = jax.tree.map(np.array, weights)
    return jax.tree.map(of, weights)


def descend(loss: Callable[[Weights], float], weights: Weights, rate: float) -> Weights:
    """:return: the weights after one step of stochastic gradient descent"""
    return jax.tree.map(lambda w, g: w - rate * g, weights, slope(loss, weights))


class Adam:
    """Kingma and Ba, 2015, algorithm 1."""

    def __init__(self, rate: float, b1: float = 0.9) -> None:
        self.rate, self.b1 = rate, b1
        self.t, self.m, self.v = 0, 0.0, 0.0

    def step(self, w: Any, g: Any) -> Any:
        self.t += 1
        self.m = self.b1 * self.m + (1.0 - self.b1) * g
        self.v = 0.999 * self.v + 0.001 * g**2
        m, v = self.m / (1.0 - self.b1**self.t), self.v / (1.0 - 0.999**self.t)
        return w - self.rate * m / (np.sqrt(v) + 1e-8)


def member(weights: Weights, i: int) -> Weights:
    """:return: the weights of one critic of an ensemble"""
    return jax.tree.map(lambda leaf: leaf[i], weights)


def dense(w: Weights, x: np.ndarray) -> np.ndarray:
    return x @ w["kernel"] + w.get("bias", 0.0)


def layer_norm(w: Weights, x: np.ndarray) -> np.ndarray:
    centred = x - x.mean(-1, keepdims=True)
    return centred / np.sqrt(x.var(-1, keepdims=True) + 1e-6) * w["scale"] + w["bias"]


def average_l1(x: np.ndarray) -> np.ndarray:
    """Fujimoto et al., NeurIPS 2023, section 4.1."""
    return x / np.maximum(np.abs(x).mean(-1, keepdims=True), 1e-8)


def relu(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0.0)


def elu(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0)))


def mlp(w: Weights, x: np.ndarray) -> np.ndarray:
    """One hidden layer, with layer norm where there is one (DroQ)."""
    x = dense(w["Dense_0"], x)
    return relu(layer_norm(w["LayerNorm_0"], x) if "LayerNorm_0" in w else x)


def simba(w: Weights, x: np.ndarray) -> np.ndarray:
    """One block: Lee et al., ICLR 2025, section 4."""
    x = dense(w["Dense_0"], x)
    inside = relu(dense(w["Dense_1"], layer_norm(w["LayerNorm_0"], x)))
    return layer_norm(w["LayerNorm_1"], x + dense(w["Dense_2"], inside))


def bro(w: Weights, x: np.ndarray) -> np.ndarray:
    """One block: Nauman et al., NeurIPS 2024, section 3."""
    x = relu(layer_norm(w["LayerNorm_0"], dense(w["Dense_0"], x)))
    inside = relu(layer_norm(w["LayerNorm_1"], dense(w["Dense_1"], x)))
    return x + layer_norm(w["LayerNorm_2"], dense(w["Dense_2"], inside))


def clipped(log_std: np.ndarray) -> np.ndarray:
    return np.clip(log_std, -20.0, 2.0)


def squashed_between(raw: np.ndarray, low: float, high: float) -> np.ndarray:
    return low + (high - low) * (1.0 + np.tanh(raw)) / 2.0


def gaussian(
    w: Weights,
    latent: np.ndarray,
    log_std_of: Callable[[np.ndarray], np.ndarray] = clipped,
) -> tuple[np.ndarray, np.ndarray]:
    """:return: mean and deviation; with gSDE (Raffin et al., CoRL 2021, equation 6) or without"""
    mean = dense(w["Dense_0"], latent)
    if "log_std" in w:
        variance = latent**2 @ np.exp(w["log_std"]) ** 2
        return np.clip(mean, -2.0, 2.0), np.sqrt(variance + 1e-6)
    return mean, np.exp(log_std_of(dense(w["Dense_1"], latent)))


def squashed(mean: np.ndarray, std: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """:return: actions, and their log-density (Haarnoja et al. 2018, appendix C)"""
    before = mean + std * noise
    density = -0.5 * noise**2 - np.log(std) - _LOG_SQRT_TAU
    # 1 - tanh^2 = cosh^-2, whose digits do not cancel where actions are near their limits.
    return np.tanh(before), np.sum(density - np.log(np.cosh(before) ** -2.0 + 1e-6), -1)


def quantile_huber(values: np.ndarray, targets: np.ndarray) -> float:
    """Dabney et al., AAAI 2018, equation 10, as a mean over quantiles; one critic's values."""
    n, total = values.shape[-1], 0.0
    for i in range(n):
        u = targets - values[:, i : i + 1]
        huber = np.where(np.abs(u) <= 1.0, 0.5 * u**2, np.abs(u) - 0.5)
        total += np.mean(np.abs((i + 0.5) / n - (u < 0.0)) * huber)
    return total / n
