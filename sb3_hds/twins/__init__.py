"""The library of twins, one file per system, and the registry that finds them."""

from sb3_hds.twins.acrobot import Acrobot
from sb3_hds.twins.cart_pole import CartPole
from sb3_hds.twins.inverted_double_pendulum import InvertedDoublePendulum
from sb3_hds.twins.inverted_pendulum import InvertedPendulum
from sb3_hds.twins.inverted_pendulum_friction import InvertedPendulumFriction
from sb3_hds.twins.mountain_car import MountainCar
from sb3_hds.twins.payload_pendulum import PayloadPendulum
from sb3_hds.twins.pendulum import Pendulum
from sb3_hds.twins.pendulum_real import PendulumReal
from sb3_hds.twins.registry import all_ids, from_env, from_spec, get, make, names, register

for _twin in (
    Acrobot,
    CartPole,
    InvertedDoublePendulum,
    InvertedPendulum,
    InvertedPendulumFriction,
    MountainCar,
    PayloadPendulum,
    Pendulum,
    PendulumReal,
):
    register(_twin)

__all__ = [
    "Acrobot",
    "CartPole",
    "InvertedDoublePendulum",
    "InvertedPendulum",
    "InvertedPendulumFriction",
    "MountainCar",
    "PayloadPendulum",
    "Pendulum",
    "PendulumReal",
    "all_ids",
    "from_env",
    "from_spec",
    "get",
    "make",
    "names",
    "register",
]
