"""Black-box optimisation by CMA-ES with a state that is a pytree of arrays."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, Int

if TYPE_CHECKING:
    from cmaes import CMA

# Separate streams of random numbers.
_SAMPLES, _RESETS, _ROUNDS = 0, 1, 2
_LARGEST = 2**31 - 1


class SearchState(NamedTuple):
    """
    State of a search.

    :param seed: of all random numbers
    :param generation: number of complete generations
    :param mean: of the distribution
    :param covariance: of the distribution, divided by ``sigma`` squared
    :param sigma: step size
    :param path_sigma: evolution path of the step size
    :param path_covariance: evolution path of the covariance
    :param returns: of this generation: one row per candidate, one column per reset; -inf: not yet
        known
    :param elites: best candidates so far, best first
    :param elite_returns: mean returns of the elites; -inf: no candidate yet
    :param ranked: whether the acting candidate has been compared on new resets
    :param n_rounds: number of ranking rounds so far
    """

    seed: np.ndarray
    generation: np.ndarray
    mean: Float[np.ndarray, " dim"]
    covariance: Float[np.ndarray, "dim dim"]
    sigma: np.ndarray
    path_sigma: Float[np.ndarray, " dim"]
    path_covariance: Float[np.ndarray, " dim"]
    returns: Float[np.ndarray, "population resets"]
    elites: Float[np.ndarray, "elites dim"]
    elite_returns: Float[np.ndarray, " elites"]
    ranked: np.ndarray
    n_rounds: np.ndarray


def init_search(
    start: Float[np.ndarray, " dim"],
    sigma: float,
    seed: int,
    population: int,
    n_resets: int,
    n_elites: int,
) -> SearchState:
    """
    :param start: mean of the first generation
    :param sigma: standard deviation of the first generation
    :param seed: of all random numbers
    :param population: candidates per generation
    :param n_resets: episodes per candidate
    :param n_elites: number of elites
    :return: the initial state of a search
    """
    dim = len(start)
    return SearchState(
        seed=np.asarray(seed, np.int64),
        generation=np.asarray(0, np.int64),
        mean=np.array(start, float),
        covariance=np.eye(dim),
        sigma=np.asarray(sigma, float),
        path_sigma=np.zeros(dim),
        path_covariance=np.zeros(dim),
        returns=np.full((population, n_resets), -np.inf),
        elites=np.tile(np.asarray(start, float), (n_elites, 1)),
        elite_returns=np.full(n_elites, -np.inf),
        ranked=np.asarray(False),
        n_rounds=np.asarray(0, np.int64),
    )


def default_population(dim: int) -> int:
    """:return: candidates per generation, as in Hansen's tutorial (2016), equation 48"""
    return 4 + int(3.0 * np.log(dim))


def candidates(state: SearchState) -> Float[np.ndarray, "population dim"]:
    """:return: the candidates of this generation, the same ones in each call"""
    return _sampled(_restored(state), len(state.returns))


def reset_seeds(state: SearchState) -> Int[np.ndarray, " resets"]:
    """:return: seeds of the resets of every candidate of this generation"""
    return _seeds(state, _RESETS, int(state.generation), state.returns.shape[1])


def round_seed(state: SearchState) -> int:
    """:return: seed of the reset of all finalists in the next ranking round"""
    return int(_seeds(state, _ROUNDS, int(state.n_rounds), 1)[0])


def tell(state: SearchState) -> SearchState:
    """
    Update the distribution (CMA-ES's "tell").

    :param state: with all returns of its generation
    :return: the state at the start of the next generation
    """
    search = _restored(state)
    points = _sampled(search, len(state.returns))
    values = state.returns.mean(axis=1)
    search.tell([(x, -value) for x, value in zip(points, values, strict=True)])
    learned = vars(search)
    pool = np.concatenate([state.elites, points])
    pool_values = np.concatenate([state.elite_returns, values])
    best = np.argsort(-pool_values, kind="stable")[: len(state.elites)]
    return state._replace(
        generation=np.asarray(search.generation, np.int64),
        mean=np.array(search.mean),
        covariance=np.array(learned["_C"]),
        sigma=np.asarray(learned["_sigma"], float),
        path_sigma=np.array(learned["_p_sigma"]),
        path_covariance=np.array(learned["_pc"]),
        returns=np.full_like(state.returns, -np.inf),
        elites=pool[best],
        elite_returns=pool_values[best],
    )


def _restored(state: SearchState) -> "CMA":
    """Set private attributes: ``cmaes`` has no public way to continue a search."""
    from cmaes import CMA  # imports scipy.stats, which is slow and only needed here

    search = CMA(
        mean=np.array(state.mean),
        sigma=float(state.sigma),
        cov=np.array(state.covariance),
        population_size=len(state.returns),
    )
    search.__dict__.update(
        _p_sigma=np.array(state.path_sigma),
        _pc=np.array(state.path_covariance),
        _g=int(state.generation),
    )
    search.reseed_rng(int(_seeds(state, _SAMPLES, int(state.generation), 1)[0]))
    return search


def _sampled(search: "CMA", n: int) -> Float[np.ndarray, "population dim"]:
    return np.stack([search.ask() for _ in range(n)])


def _seeds(state: SearchState, purpose: int, index: int, n: int) -> Int[np.ndarray, " n"]:
    return np.random.default_rng([int(state.seed), purpose, index]).integers(_LARGEST, size=n)
