"""Arguments of OpenLoop."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import KW_ONLY

import numpy as np

from sb3_hds.algos.base.config import Config, between
from sb3_hds.algos.open_loop.gait import GaitSpace
from sb3_hds.algos.open_loop.robot import Robot
from sb3_hds.core.transforms.oscillators import LEADS


@dataclasses.dataclass(frozen=True, eq=False)
class OpenLoopConfig(Config):
    """
    Arguments of OpenLoop.

    :param policy: ``"MlpPolicy"`` (the only one, without a network), or the environment
    :param env: an environment, its id, or a vectorised environment: candidates run in parallel
    :param population_size: candidates per generation; None: ``4 + 3 log(dim)``
    :param n_resets: episodes per candidate and generation
    :param horizon: steps of such an episode; None: until it ends
    :param initial_sigma: standard deviation of the first generation, before squashing
    :param n_elites: number of best candidates that are ranked at the end
    :param ranking_share: share of the steps of ``learn`` for the ranking
    :param kp: command per rad of error
    :param kd: command per rad/s
    :param gain_factor: gains are searched within this factor up and down; 1: fixed gains
    :param amplitude: largest amplitude [rad]; without joints, in half ranges of the command
    :param offset: largest offset from the model's rest position, up and down [rad]; without joints,
        in half ranges of the command
    :param frequency: smallest and largest frequency [Hz]
    :param same_frequency: whether swing and stance have the same frequency
    :param phases: False: all joints move in phase
    :param gait: all legs move alike, each with its own lead: ``"trot"``, ``"pace"``, ``"bound"`` or
        ``"walk"`` of the legs front left, front right, hind left, hind right, or a lead for each
        leg [rad]. Joints must be sorted by leg and have the same sense. None: independent joints
    :param control: ``"track"`` joints, ``"direct"`` commands, or ``"auto"``
    :param joints: read from the ``"observation"``, from the ``"env"``, or ``"auto"``
    :param dt: time step [s]; None: that of the environment
    :param policy_kwargs: the policy has none
    """

    _: KW_ONLY
    population_size: int | None = None
    n_resets: int = 2
    horizon: int | None = None
    initial_sigma: float = 1.0
    n_elites: int = 5
    ranking_share: float = 0.15
    kp: float = 3.0
    kd: float = 0.2
    gain_factor: float = 4.5
    amplitude: float = 1.0
    offset: float = 0.5
    frequency: Sequence[float] = (0.4, 4.0)
    same_frequency: bool = False
    phases: bool = True
    gait: str | Sequence[float] | None = None
    control: str = "auto"
    joints: str = "auto"
    dt: float | None = None
    derived = ("population_size", "horizon")

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_counts({"population_size": 2, "n_resets": 1, "horizon": 1, "n_elites": 1})
        for name in ("initial_sigma", "amplitude", "offset"):
            fine = between(value := getattr(self, name), 0.0, math.inf) and value > 0.0
            self.require(fine, name, "a finite number above 0")
        self.require_range(0.0, math.inf, "a finite number of at least 0", "kp", "kd")
        self.require_range(0.0, 1.0, "from 0 to 1", "ranking_share")
        self.require_range(1.0, math.inf, "a finite number of at least 1", "gain_factor")
        limits = np.atleast_1d(np.asarray(self.frequency, float)).tolist()
        fine = len(limits) == 2 and 0.0 < limits[0] < limits[1] < math.inf
        self.require(fine, "frequency", "two numbers, 0 < lowest < highest")
        fine = self.dt is None or (between(self.dt, 0.0, math.inf) and self.dt > 0.0)
        self.require(fine, "dt", "a finite number above 0, or None")
        if isinstance(self.gait, Sequence) and not isinstance(self.gait, str):
            fine = bool(self.gait) and all(between(x, -math.inf, math.inf) for x in self.gait)
        else:
            fine = self.gait is None or self.gait in LEADS
        named = ", ".join(map(repr, LEADS))
        self.require(fine, "gait", f"one of {named}, a lead [rad] for each leg, or None")
        self.require_choice("control", ("auto", "track", "direct"))
        self.require_choice("joints", ("auto", "observation", "env"))

    @property
    def leads(self) -> tuple[float, ...]:
        """Lead of each leg [rad]."""
        if self.gait is None:
            return (0.0,)
        return LEADS[self.gait] if isinstance(self.gait, str) else tuple(self.gait)

    def gait_space(self, robot: Robot) -> GaitSpace:
        """:return: the search space of a robot's gaits"""
        lower, upper, rest = (np.array(x) for x in (robot.lower, robot.upper, robot.rest))
        half = 0.5 * (upper - lower) if robot.control == "direct" else np.ones(len(rest))
        centre = np.clip(rest, lower, upper)
        lowest, highest = self.frequency
        return GaitSpace(
            amplitude=self.amplitude * half,
            offset=np.stack([centre - self.offset * half, centre + self.offset * half], axis=1),
            frequency=(lowest, highest),
            kp=self.kp,
            kd=self.kd,
            gain_factor=self.gain_factor if robot.control == "track" else 1.0,
            same_frequency=self.same_frequency,
            phases=self.phases,
            leads=self.leads,
        )
