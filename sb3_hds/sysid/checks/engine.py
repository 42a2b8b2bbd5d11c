"""Refuse twins of which an identification would take hours."""

from sb3_hds.core import Twin
from sb3_hds.core.twin import plant_of
from sb3_hds.errors import CalibrationError
from sb3_hds.twins.mujoco.engine.twin import EngineTwin


def refuse_engine(twin: Twin, what: str) -> None:
    """
    :param what: the name of the function that was called
    :raises CalibrationError: for a twin on MuJoCo's engine
    """
    if not isinstance(plant_of(twin), EngineTwin):
        return
    n_columns = 2 * len(twin.joints) + len(twin.parameters)
    raise CalibrationError(
        f"{what} does not take {twin.name}, a twin on MuJoCo's engine: it linearises every window "
        f"of the data for every candidate, here by {n_columns} finite differences of each step, "
        "which takes hours. If nothing is in contact in the data, pass "
        "twins.from_mujoco(model, ignore=['contacts', 'limits'])."
    )
