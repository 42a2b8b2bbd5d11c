"""The library of twins, one file per system, and the registry that finds them."""

from sb3_hds.twins.pendulum import Pendulum
from sb3_hds.twins.registry import all_ids, from_env, from_spec, get, make, names, register

for _twin in (Pendulum,):
    register(_twin)

__all__ = ["Pendulum", "all_ids", "from_env", "from_spec", "get", "make", "names", "register"]
