"""
Prior knowledge of an engineer: prior odds, physical limits, and which effects exclude each other.

Odds are relative to viscous friction, which every joint has and few models include. They decide
between explanations that the data cannot distinguish, and a rarer cause has to explain more before
it is named.
"""

import functools
import math
from typing import NamedTuple

from sb3_hds.core import Twin
from sb3_hds.sysid.estimation.candidates import Candidate
from sb3_hds.sysid.motion.motion import SET_POINTS


class Plausibility(NamedTuple):
    """
    :param family: effects of one family at one place exclude each other
    :param rarity: minus the logarithm of the prior odds
    :param lower: smallest change from the null that a machine may have
    :param upper: largest
    :param reason: for the odds
    """

    family: str
    rarity: float
    lower: float = -math.inf
    upper: float = math.inf
    reason: str = ""


_ONE_WAY = 0.0

#: by the name of an effect; ``parameter`` stands for the twin's own parameters
TABLE: dict[str, Plausibility] = {
    "viscous_friction": Plausibility(
        "viscous", 0.0, _ONE_WAY, reason="every bearing and every gear has it, few models do"
    ),
    "coulomb_friction": Plausibility(
        "dry", 0.0, _ONE_WAY, reason="every seal and every gear has it, few models do"
    ),
    "constant_force": Plausibility("offset", 1.0, reason="an offset of the drive or of gravity"),
    "parameter": Plausibility("parameter", 1.0, reason="data sheets are off by 10 to 50 %"),
    "torque_gain": Plausibility(
        "gain", 1.5, -0.9, 4.0, reason="torque constants are known to 10 % or so"
    ),
    "action_delay": Plausibility("late", 1.5, reason="buses and controllers take a cycle or two"),
    "motor_lag": Plausibility("late", 2.0, reason="current loops are fast beside joints"),
    "stribeck_friction": Plausibility("dry", 2.0, _ONE_WAY, reason="shows at low speed only"),
    "quadratic_drag": Plausibility("drag", 2.0, _ONE_WAY, reason="only in media, or at speed"),
    "concave_friction": Plausibility(
        "viscous", 2.0, _ONE_WAY, reason="of greased gears over a wide range of speeds"
    ),
    "load_dependent_friction": Plausibility("dry", 2.5, _ONE_WAY, reason="of gears under load"),
    "directional_viscous_friction": Plausibility("viscous", 3.0, _ONE_WAY, reason="few gears"),
    "directional_coulomb_friction": Plausibility("dry", 3.0, _ONE_WAY, reason="few gears"),
    "stiffness": Plausibility("spring", 2.5, _ONE_WAY, reason="cables and hoses, where there are"),
    "cubic_stiffness": Plausibility("cubic", 3.5, _ONE_WAY, reason="rare outside of flexures"),
    "cogging": Plausibility("cogging", 3.5, _ONE_WAY, reason="of motors without gears"),
    "dead_zone": Plausibility("dead zone", 3.0, _ONE_WAY, reason="valves, cheap amplifiers"),
    "saturation": Plausibility("saturation", 3.0, reason="known from the data sheet, mostly"),
    "directional_gain": Plausibility("gain", 3.5, -0.9, 4.0, reason="of one-sided amplifiers"),
    "sensor_bias": Plausibility("zero", 2.5, reason="zeros are set by hand"),
    "sensor_scale": Plausibility("scale", 4.0, -0.5, 0.5, reason="encoders count well"),
    "sensor_delay": Plausibility("late sensor", 3.0, reason="cameras and filters"),
    "sign_flip": Plausibility("sign", 3.0, reason="wiring, and conventions of others"),
}
_UNKNOWN = Plausibility("", 3.0)
# Additional rarity of amplifier effects on set points, which arrive unchanged, if late.
_SET_POINT = 3.0
_OF_AMPLIFIERS = ("torque_gain", "directional_gain", "dead_zone", "saturation")


@functools.cache
def plausibility(effect: str) -> Plausibility:
    """:param effect: name in the catalogue, or ``parameter.NAME``; others are taken to be rare"""
    name = effect.partition(".")[0]
    return TABLE.get(name, _UNKNOWN._replace(family=name))


def rarity_of(candidate: Candidate, twin: Twin) -> float:
    """:return: minus the logarithm of the prior odds of a candidate at its place in a twin"""
    own = plausibility(candidate.name).rarity
    if candidate.slot != "actuator" or candidate.name not in _OF_AMPLIFIERS:
        return own
    return own + _SET_POINT if twin.actuators[candidate.index].unit in SET_POINTS else own
