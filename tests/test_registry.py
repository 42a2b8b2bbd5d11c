"""Adding an algorithm takes one file, one entry and one yml: here, one is added to a copy."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent

ALGORITHM = '''
"""SAC with the mean of its critics."""

from sb3_hds.algos.model_free.sac.algorithm import SoftActorCritic


class MeanSAC(SoftActorCritic):
    """SAC with the mean of its critics."""
'''
ENTRY = '    "mean_sac": Entry("MeanSAC", "model_free.sac.mean_sac", _GAUSSIAN, "sac"),\n'
YML = "default:\n  n_timesteps: 1000\n  policy: MlpPolicy\n"

USE = """
import io, sys
from types import SimpleNamespace

import sb3_hds
from rl_zoo_plugin import tables
from sb3_hds import MeanSAC, algos

sys.path.insert(0, sys.argv[1])
import small_models

assert sb3_hds.__file__.startswith(sys.argv[2])
assert algos.ALL["mean_sac"] is MeanSAC is algos.MeanSAC
model = small_models.small("mean_sac").learn(15)
file = io.BytesIO()
model.save(file)
file.seek(0)
policy = sb3_hds.load_policy(file)
file.seek(0)
assert type(MeanSAC.load(file).policy) is type(policy) is algos.GaussianPolicy
utils = SimpleNamespace(ALGOS={})
samplers = SimpleNamespace(HYPERPARAMS_SAMPLER={}, HYPERPARAMS_CONVERTER={})
tables.EXTENSIONS["rl_zoo3.utils"](utils)
tables.EXTENSIONS["rl_zoo3.hyperparams_opt"](samplers)
assert utils.ALGOS["mean_sac"].resolve() is MeanSAC
assert {"mean_sac"} <= set(samplers.HYPERPARAMS_SAMPLER) & set(samplers.HYPERPARAMS_CONVERTER)
assert tables.hyperparams_file("mean_sac").read_text().startswith("default")
assert "mean_sac" in small_models.MODEL_FREE
"""


def test_an_algorithm_that_is_added_is_known_everywhere(tmp_path):
    for folder in ("sb3_hds", "rl_zoo_plugin", "hyperparams"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=ignored)
    algorithms = tmp_path / "sb3_hds" / "algos"
    (algorithms / "model_free" / "sac" / "mean_sac.py").write_text(ALGORITHM)
    (tmp_path / "hyperparams" / "mean_sac.yml").write_text(YML)
    registry = algorithms / "registry.py"
    before, opening, entries = registry.read_text().partition("ALGORITHMS: dict[str, Entry] = {\n")
    registry.write_text(before + opening + ENTRY + entries)

    command = (sys.executable, "-c", USE, ROOT / "tests", tmp_path)
    environ = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, env=environ, cwd=tmp_path, text=True, capture_output=True)

    assert done.returncode == 0, done.stderr
