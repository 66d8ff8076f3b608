"""Training on a GPU, where there is one."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(shutil.which("nvidia-smi") is None, reason="needs a GPU")

TRAIN = """if True:
    import sys
    import torch as th
    from toy import GUIDED, Line, build
    from sb3_sap.algorithms import ALGORITHMS

    cls = ALGORITHMS[sys.argv[1]]
    model = build(cls, device="cuda", **{"predictor_kwargs": {"optimizer_class": sys.argv[2]}})
    model.learn(200)
    model.save(sys.argv[3])
    assert {p.device.type for p in [*model.policy.parameters(), *model.predictor.parameters()]} == {"cuda"}
    assert model.predictor.fitted
    observation = model.observation_space.sample()
    loaded = cls.load(sys.argv[3], device="cpu")
    near = abs(model.predict(observation, deterministic=True)[0] - loaded.predict(observation, deterministic=True)[0])
    assert (near < 1e-5).all()
    model.predict(observation, guided=True)
"""


@pytest.mark.parametrize("algo", ["ddpg_ap", "td3_ap", "sac_ap", "tqc_ap", "crossq_ap", "dqn_ap", "qrdqn_ap"])
@pytest.mark.parametrize("optimizer", ["Adam", "Adagrad"])
def test_algorithm_trains_on_a_gpu_and_loads_on_the_cpu(algo, optimizer, tmp_path):
    visible = os.environ["SB3_SAP_TEST_GPUS"]
    env = {name: value for name, value in os.environ.items() if name != "CUDA_VISIBLE_DEVICES"}
    env |= {} if visible == "all" else {"CUDA_VISIBLE_DEVICES": visible}
    env["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parent), env.get("PYTHONPATH", "")])
    subprocess.run([sys.executable, "-c", TRAIN, algo, optimizer, str(tmp_path / "model.zip")], env=env, check=True)
