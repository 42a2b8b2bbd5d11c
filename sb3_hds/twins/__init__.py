"""The library of twins, one file per system, and its registry."""

from sb3_hds.core import Twin
from sb3_hds.twins.check import check
from sb3_hds.twins.check_result import CheckItem, TwinCheck
from sb3_hds.twins.environments.acrobot import Acrobot
from sb3_hds.twins.environments.cart_pole import CartPole
from sb3_hds.twins.environments.inverted_double_pendulum import InvertedDoublePendulum
from sb3_hds.twins.environments.inverted_pendulum import InvertedPendulum
from sb3_hds.twins.environments.inverted_pendulum_friction import InvertedPendulumFriction
from sb3_hds.twins.environments.mountain_car import MountainCar
from sb3_hds.twins.environments.payload_pendulum import PayloadPendulum
from sb3_hds.twins.environments.pendulum import Pendulum
from sb3_hds.twins.environments.pendulum_real import PendulumReal
from sb3_hds.twins.locomotion.ant import Ant
from sb3_hds.twins.locomotion.half_cheetah import HalfCheetah
from sb3_hds.twins.locomotion.hopper import Hopper
from sb3_hds.twins.locomotion.pusher import Pusher
from sb3_hds.twins.locomotion.reacher import Reacher
from sb3_hds.twins.locomotion.swimmer import Swimmer
from sb3_hds.twins.locomotion.walker2d import Walker2d
from sb3_hds.twins.mujoco import (
    ContactTwin,
    MechanismTwin,
    Written,
    from_mujoco,
    write_model,
    write_models,
)
from sb3_hds.twins.registry import all_ids, from_env, from_spec, get, make, names, register
from sb3_hds.twins.rigs.double_pendulum import DoublePendulum
from sb3_hds.twins.rigs.duffing import Duffing
from sb3_hds.twins.rigs.free_pendulum import FreePendulum
from sb3_hds.twins.rigs.furuta import Furuta
from sb3_hds.twins.rigs.linear_axis import LinearAxis
from sb3_hds.twins.rigs.rig import Rig
from sb3_hds.twins.rigs.servo_pendulum import ServoPendulum

__all__ = [
    "Acrobot",
    "Ant",
    "CartPole",
    "CheckItem",
    "ContactTwin",
    "DoublePendulum",
    "Duffing",
    "FreePendulum",
    "Furuta",
    "HalfCheetah",
    "Hopper",
    "InvertedDoublePendulum",
    "InvertedPendulum",
    "InvertedPendulumFriction",
    "LinearAxis",
    "MechanismTwin",
    "MountainCar",
    "PayloadPendulum",
    "Pendulum",
    "PendulumReal",
    "Pusher",
    "Reacher",
    "Rig",
    "ServoPendulum",
    "Swimmer",
    "TwinCheck",
    "Walker2d",
    "Written",
    "all_ids",
    "check",
    "from_env",
    "from_mujoco",
    "from_spec",
    "get",
    "make",
    "names",
    "register",
    "write_model",
    "write_models",
]

for _name in __all__:
    _twin = globals()[_name]
    if isinstance(_twin, type) and issubclass(_twin, Twin) and hasattr(_twin, "name"):
        register(_twin, listed=_twin not in (ContactTwin, MechanismTwin))
