"""Learning algorithms behind Stable-Baselines3's API, one file each."""

from sb3_hds.algos.bro import BRO
from sb3_hds.algos.compiled import Episodes, learn_compiled
from sb3_hds.algos.crossq import CrossQ
from sb3_hds.algos.droq import DroQ
from sb3_hds.algos.executed_actions import ExecutedDictReplayBuffer, ExecutedReplayBuffer
from sb3_hds.algos.gaussian_policy import GaussianPolicy
from sb3_hds.algos.gsde_sac import GSDESAC
from sb3_hds.algos.hds import HDS
from sb3_hds.algos.open_loop import OpenLoop
from sb3_hds.algos.oscillator_policy import OscillatorPolicy
from sb3_hds.algos.pods import PODS
from sb3_hds.algos.policy_file import load_policy
from sb3_hds.algos.simba import SimbaSAC
from sb3_hds.algos.td7 import TD7
from sb3_hds.algos.tqc import TQC
from sb3_hds.algos.train_beside import TrainBeside
from sb3_hds.algos.twin_policy import TwinPolicy

#: every algorithm by its id in the zoo: listed here, it is tested, registered and documented
ALL = {
    "pods": PODS,
    "hds": HDS,
    "gsde_sac": GSDESAC,
    "droq": DroQ,
    "crossq_jax": CrossQ,
    "tqc_jax": TQC,
    "simba": SimbaSAC,
    "td7": TD7,
    "bro": BRO,
    "openloop": OpenLoop,
}

__all__ = [
    "ALL",
    "BRO",
    "GSDESAC",
    "HDS",
    "PODS",
    "TD7",
    "TQC",
    "CrossQ",
    "DroQ",
    "Episodes",
    "ExecutedDictReplayBuffer",
    "ExecutedReplayBuffer",
    "GaussianPolicy",
    "OpenLoop",
    "OscillatorPolicy",
    "SimbaSAC",
    "TrainBeside",
    "TwinPolicy",
    "learn_compiled",
    "load_policy",
]
