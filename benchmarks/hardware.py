"""Stand-ins for hardware with wrong data sheets, and the returns of policies on them."""

from pathlib import Path

from episodes import returns_of
from runs import CACHE, code_version

PENDULUM, CART = "sb3_hds/PendulumReal-v1", "sb3_hds/InvertedPendulumFriction-v5"
CELLS = {
    "light": (PENDULUM, {"mass": 0.75}),
    "a little light": (PENDULUM, {"mass": 0.875}),
    "a little heavy": (PENDULUM, {"mass": 1.125}),
    "heavy": (PENDULUM, {"mass": 1.25}),
    "short": (PENDULUM, {"length": 0.5}),
    "a little short": (PENDULUM, {"length": 0.75}),
    "a little long": (PENDULUM, {"length": 1.25}),
    "long": (PENDULUM, {"length": 1.5}),
    "noise 0.1": (PENDULUM, {"noise": 0.1}),
    "noise 0.2": (PENDULUM, {"noise": 0.2}),
    "heavy, long": (PENDULUM, {"mass": 1.25, "length": 1.25}),
    "heavy, long, noise 0.1": (PENDULUM, {"mass": 1.25, "length": 1.25, "noise": 0.1}),
    "heavy, long, noise 0.2": (PENDULUM, {"mass": 1.25, "length": 1.25, "noise": 0.2}),
    "friction": (PENDULUM, {"friction": 0.3, "noise": 0.01}),
    "drag": (PENDULUM, {"drag": 0.04, "noise": 0.01}),
    "delay": (PENDULUM, {"delay": 0.1, "noise": 0.01}),
    "cart friction": (CART, {"hinge_friction": 2.0, "slider_friction": 20.0, "swing_up": True}),
    "worn": (
        PENDULUM,
        {"mass": 1.25, "length": 1.25, "friction": 0.2, "drag": 0.04, "noise": 0.01},
    ),
    "euler steps": (PENDULUM, {}),
}
#: cells whose data sheet is right, and whose twin has another integrator than the system
OTHER_TWIN = {"euler steps": "Pendulum"}
#: steps of an episode
LENGTH = {PENDULUM: 200, CART: 250}
N_STARTS = 50


def make(cell: str):
    """:return: the real system"""
    import gymnasium

    import sb3_hds  # noqa: F401

    env_id, settings = CELLS[cell]
    return gymnasium.make(env_id, **settings, max_episode_steps=LENGTH[env_id])


def length_of(cell: str) -> int:
    return LENGTH[CELLS[cell][0]]


def data_sheet(cell: str):
    """:return: the twin according to the data sheet, without the hidden deviations"""
    from sb3_hds import twins

    env_id = CELLS[cell][0]
    return twins.make(
        OTHER_TWIN.get(cell, env_id), **({"swing_up": True} if env_id == CART else {})
    )


def pretrained(cell: str, seed: int, **changes):
    """
    :return: HDS that has planned in the data sheet's twin and has seen no data yet, in the cell's
        environment. It is trained once for all cells that share a data sheet, by this version of
        the package.
    """
    from sb3_hds import HDS

    twin = data_sheet(cell)
    path = kept_at(twin.name, seed, changes)
    if not path.exists():
        model = HDS(make(cell), twin=twin, seed=seed, **changes)
        model.learn(0).save(path)
    return HDS.load(path, env=make(cell))


def kept_at(twin: str, seed: int, changes: dict) -> Path:
    """:return: file of a model, by the version of the code"""
    import sb3_hds

    label = "_".join(f"{name}={value}" for name, value in sorted(changes.items()))
    version = code_version(Path(sb3_hds.__file__).parent)
    return CACHE / "models" / version / f"{twin}_{seed}_{label or 'plain'}.zip"


def return_of(model, cell: str) -> float:
    """:return: mean return over fixed start states of the real system"""
    return float(returns_of(model, [make(cell) for _ in range(N_STARTS)], 50_000).mean())
