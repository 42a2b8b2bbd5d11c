"""
Solvers for the quadratic programmes of ``ActionShield``: time, error and violation.

    pip install daqp quadprog proxsuite piqp clarabel osqp
    python benchmarks/qp_solvers.py [--n-problems 200]

The problems are random projections ``min |u - a|^2``, ``G u <= h``, ``-1 <= u <= 1`` of 2 to 12
commands, with twice as many constraints as commands, some of them active. Each problem is solved
once without a warm start, as a step of an environment does, at tolerances of 1e-8 or the solver's
own. Errors are measured against the mean of the exact methods that are installed (daqp, quadprog).
Solvers that are not installed are left out.
"""

import argparse
import contextlib
import importlib.metadata
import io
import time
from collections.abc import Callable, Iterator

import numpy as np
from runs import save

SIZES = (2, 4, 8, 12)


def daqp(a, G, h):
    import daqp

    n, m = len(a), len(h)
    upper, lower = np.concatenate([np.ones(n), h]), np.append(-np.ones(n), np.full(m, -1e30))
    return daqp.solve(np.eye(n), -a, G, upper, lower, np.zeros(n + m, np.int32))[0]


def quadprog(a, G, h):
    import quadprog

    n = len(a)
    C = np.vstack([-G, np.eye(n), -np.eye(n)]).T
    return quadprog.solve_qp(np.eye(n), a, C, np.concatenate([-h, -np.ones(2 * n)]))[0]


def proxsuite(a, G, h):
    import proxsuite

    n = len(a)
    lower, upper = np.append(np.full(len(h), -1e20), -np.ones(n)), np.append(h, np.ones(n))
    C = np.vstack([G, np.eye(n)])
    solve = proxsuite.proxqp.dense.solve
    return solve(H=np.eye(n), g=-a, A=None, b=None, C=C, l=lower, u=upper, eps_abs=1e-8).x


def piqp(a, G, h):
    import piqp

    n, solver = len(a), piqp.DenseSolver()
    solver.settings.eps_abs = 1e-8
    solver.setup(np.eye(n), -a, None, None, G, None, h, -np.ones(n), np.ones(n))
    solver.solve()
    return np.array(solver.result.x)


def clarabel(a, G, h):
    import clarabel
    from scipy import sparse

    n, settings = len(a), clarabel.DefaultSettings()
    settings.verbose = False
    A = sparse.csc_matrix(np.vstack([G, np.eye(n), -np.eye(n)]))
    b = np.append(h, np.ones(2 * n))
    cone = [clarabel.NonnegativeConeT(len(b))]
    P = sparse.eye(n, format="csc")
    return np.array(clarabel.DefaultSolver(P, -a, A, b, cone, settings).solve().x)


def osqp(a, G, h):
    import osqp
    from scipy import sparse

    n, solver = len(a), osqp.OSQP()
    A = sparse.csc_matrix(np.vstack([G, np.eye(n)]))
    lower, upper = np.append(np.full(len(h), -np.inf), -np.ones(n)), np.append(h, np.ones(n))
    accuracy = {"eps_abs": 1e-8, "eps_rel": 1e-8, "max_iter": 100_000}
    P = sparse.eye(n, format="csc")
    solver.setup(P, -a, A, lower, upper, verbose=False, **accuracy)
    return solver.solve().x


SOLVERS = (daqp, quadprog, proxsuite, piqp, clarabel, osqp)
EXACT = ("daqp", "quadprog")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--n-problems", type=int, default=200)
    n_problems = parser.parse_args().n_problems
    rows = [row for n in SIZES for row in measured(n, n_problems)]
    print(save(rows, "qp_solvers").to_string(index=False))


def measured(n: int, n_problems: int) -> Iterator[dict]:
    """One row for each solver that is installed."""
    generator = np.random.default_rng(n)
    problems = [problem(n, 2 * n, generator) for _ in range(n_problems)]
    found = {solve.__name__: timed(solve, problems) for solve in SOLVERS if version_of(solve)}
    exact = np.mean([found[name][0] for name in EXACT if name in found], 0)
    for solve in SOLVERS:
        if solve.__name__ not in found:
            continue
        answers, seconds = found[solve.__name__]
        excess = [np.max(G @ u - h) for u, (_, G, h) in zip(answers, problems, strict=True)]
        yield {
            "solver": solve.__name__,
            "version": version_of(solve),
            "n_commands": n,
            "n_constraints": 2 * n,
            "median_us": 1e6 * np.median(seconds),
            "p99_us": 1e6 * np.quantile(seconds, 0.99),
            "largest_error": np.max(np.abs(answers - exact)),
            "largest_violation": max(0.0, *excess),
        }


def problem(n: int, m: int, generator: np.random.Generator):
    G = generator.normal(size=(m, n))
    h = G @ generator.uniform(-0.5, 0.5, n) + generator.uniform(0.0, 0.3, m)
    return generator.uniform(-1.0, 1.0, n), G, h


def timed(solve: Callable, problems: list) -> tuple[np.ndarray, np.ndarray]:
    answers, seconds = [], []
    for given in problems:
        with contextlib.redirect_stdout(io.StringIO()):
            begin = time.perf_counter()
            answers.append(solve(*given))
            seconds.append(time.perf_counter() - begin)
    return np.array(answers), np.array(seconds)


def version_of(solve: Callable) -> str | None:
    try:
        return importlib.metadata.version(solve.__name__)
    except importlib.metadata.PackageNotFoundError:
        return None


if __name__ == "__main__":
    main()
