"""The model card on the Hugging Face Hub: its text, and the lines of Python that load the model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

CARD = """\
---
{{{{ card_data }}}}
---

# {algo} on {env_id}

{class_name} of sb3_sap, a Stable-Baselines3 model that learns which actions are
permissible while it learns to act.{pictures}

## Results

{results}

## Use

A model file holds pickled objects: loading one runs its code. Load only what you trust.

```python
{use}
```{predictor}

## How it was made

```
{command}
```

with sb3_sap {version} and Stable-Baselines3 {sb3_version}.
"""
#: The AP predictor has a file of its own, which holds no code.
PREDICTOR = """

The AP predictor alone judges actions, or begins the training of any other algorithm (`predictor=`). Its file holds no
code:

```python
from huggingface_sb3 import load_from_hub
from sb3_sap import PermissibilityPredictor

predictor = PermissibilityPredictor.load(load_from_hub("{repo_id}", "predictor.pt"))
predictor.probabilities(obs, actions)  # of batches
```"""
USE = """\
from huggingface_sb3 import load_from_hub
from sb3_sap import {class_name}

model = {class_name}.load(load_from_hub("{repo_id}", "{filename}"))"""
#: For a model that learned on normalised observations: loads both files and makes the environment.
USE_NORMALISED = """\
from huggingface_sb3 import load_from_hub
from sb3_sap import {class_name}
from sb3_sap.evaluation import make_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

env = DummyVecEnv([lambda: make_env({env_arguments})])
env = VecNormalize.load(load_from_hub("{repo_id}", "{statistics}"), env)
env.training = env.norm_reward = False
model = {class_name}.load(load_from_hub("{repo_id}", "{filename}"), env=env)"""


def env_arguments(env_id: str, env_kwargs: Mapping[str, Any]) -> str:
    """The arguments of `make_env`, as Python."""
    return ", ".join([f'"{env_id}"', *(f"{name}={value!r}" for name, value in env_kwargs.items())])
