"""
What it takes to add something: an algorithm is one file, one entry and one yml, an effect one class
and one name, a twin one file and one name. Here, one of each is added to a copy of the package.
"""

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
IMPORT = "from sb3_hds.twins.rigs.heavy_axis import HeavyAxis\n"
ENTRY = '    "mean_sac": Entry("MeanSAC", "model_free.sac.mean_sac", _GAUSSIAN, "sac"),\n'
YML = "default:\n  n_timesteps: 1000\n  policy: MlpPolicy\n"

EFFECT = """

class CubicDrag(JointEffect):
    name = "cubic_drag"
    parameters = {"c": Parameter(null=0.0, scale=0.05, unit="N m s^3/rad^3", lower=0.0)}
    explanation = "The joint resists motion in proportion to the cube of its speed."
    source = "none: it is made up"

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        return -params["c"] * joint.v**3
"""
TWIN = """
from sb3_hds.twins.rigs.linear_axis import LinearAxis


class HeavyAxis(LinearAxis):
    name = "HeavyAxis"
"""

USE = """
import io, sys
from types import SimpleNamespace

import sb3_hds
from rl_zoo_plugin import tables
from sb3_hds import MeanSAC, algos, effects, twins
from sb3_hds.cli import main

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

assert "HeavyAxis" in twins.names()
drag = effects.effect_named("cubic_drag", effects.ALL)
twin = twins.make("HeavyAxis").extend(drag(0, c=0.2))
assert twins.from_spec(twin.to_spec(), effects.KNOWN) == twin
assert main(["effects"]) == 0
"""


def insert(file: Path, *changes: tuple[str, str]) -> None:
    """Write lines behind others."""
    text = file.read_text()
    for behind, line in changes:
        before, found, after = text.partition(behind)
        assert found, behind
        text = before + found + line + after
    file.write_text(text)


def test_what_is_added_is_known_everywhere(tmp_path):
    for folder in ("sb3_hds", "rl_zoo_plugin", "hyperparams"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=ignored)
    algorithms = tmp_path / "sb3_hds" / "algos"
    (algorithms / "model_free" / "sac" / "mean_sac.py").write_text(ALGORITHM)
    (tmp_path / "hyperparams" / "mean_sac.yml").write_text(YML)
    insert(algorithms / "registry.py", ("ALGORITHMS: dict[str, Entry] = {\n", ENTRY))
    effects, twins = tmp_path / "sb3_hds" / "effects", tmp_path / "sb3_hds" / "twins"
    (effects / "joint.py").write_text((effects / "joint.py").read_text() + EFFECT)
    insert(
        effects / "__init__.py",
        ("from sb3_hds.effects.joint import (\n", "    CubicDrag,\n"),
        ("ALL: tuple[type[Effect], ...] = (\n", "    CubicDrag,\n"),
    )
    (twins / "rigs" / "heavy_axis.py").write_text(TWIN)
    insert(
        twins / "__init__.py",
        ("names, register\n", IMPORT),
        ("__all__ = [\n", '    "HeavyAxis",\n'),
    )

    command = (sys.executable, "-c", USE, ROOT / "tests", tmp_path)
    environ = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, env=environ, cwd=tmp_path, text=True, capture_output=True)

    assert done.returncode == 0, done.stderr
    assert "cubic_drag" in done.stdout
