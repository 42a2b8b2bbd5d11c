"""All algorithms together."""

from sb3_hds.algos.bro import BRO
from sb3_hds.algos.crossq import CrossQ
from sb3_hds.algos.droq import DroQ
from sb3_hds.algos.gsde_sac import GSDESAC
from sb3_hds.algos.hds import HDS
from sb3_hds.algos.open_loop import OpenLoop
from sb3_hds.algos.pods import PODS
from sb3_hds.algos.simba import SimbaSAC
from sb3_hds.algos.td7 import TD7
from sb3_hds.algos.tqc import TQC

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
