"""The network of the AP predictor: from a state and an action to the logit of each part of the action (section 4.2)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor, create_mlp
from torch import nn

from sb3_sap.common.action_parts import ActionParts
from sb3_sap.predictor.arguments import check_arguments, checked_output_per_action, optimizer_named
from sb3_sap.predictor.encoding import encoded_actions, own_inputs

#: Balanced validation accuracy from which E is accurate enough for α; below it, ``alpha_low`` holds (section 4.3).
SUFFICIENT_ACCURACY = 0.7


class JudgingNetwork(BaseModel):
    """Judges actions; :class:`~sb3_sap.predictor.network.PermissibilityPredictor` has its parameters, and fits it."""

    features_extractor: BaseFeaturesExtractor
    n_updates: th.Tensor
    accuracies: th.Tensor  # (k,) balanced validation accuracy of each part, NaN before the first validation

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        net_arch: tuple[int, ...] | list[int] = (128, 256),
        activation_fn: type[nn.Module] = nn.ReLU,
        learning_rate: float = 1e-3,
        weight_decay: float = 1e-4,
        batch_size: int = 128,
        optimizer_class: type[th.optim.Optimizer] | str = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        features_extractor_class: type[BaseFeaturesExtractor] = FlattenExtractor,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        action_parts: Mapping[str, Sequence[int]] | None = None,
        threshold: float = 0.5,
        output_per_action: bool = False,
    ):
        optimizer_class = optimizer_named(optimizer_class)
        check_arguments(net_arch, batch_size, learning_rate, threshold)
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class=features_extractor_class,
            features_extractor_kwargs=features_extractor_kwargs,
            normalize_images=normalize_images,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
        )
        self.batch_size = batch_size
        self.parts = ActionParts.of(action_parts, action_space)
        self.output_per_action = checked_output_per_action(output_per_action, action_space, bool(self.parts))
        #: What verdicts subtract from the logit of the probability, so that above zero means permissible.
        self.offset = math.log(threshold / (1 - threshold))
        self._arguments = {
            "net_arch": list(net_arch),
            "activation_fn": activation_fn,
            "learning_rate": learning_rate,
            "weight_decay": weight_decay,
            "batch_size": batch_size,
            "action_parts": self.parts.as_dict(),
            "threshold": threshold,
            "output_per_action": output_per_action,
        }
        self.features_extractor = self.make_features_extractor()
        of_action = get_flattened_obs_dim(action_space)  # inputs, or outputs
        n_inputs = self.features_extractor.features_dim + (0 if output_per_action else of_action)
        n_outputs = of_action if output_per_action else len(self.parts) or 1
        self.head = nn.Sequential(*create_mlp(n_inputs, n_outputs, list(net_arch), activation_fn))
        self._normalises_batches = any(isinstance(layer, nn.modules.batchnorm._BatchNorm) for layer in self.modules())
        # Seeds the random layers, such as dropout, of each fit.
        self._seed = th.initial_seed()
        # Buffers are saved with the weights: a loaded E knows whether it was ever fitted.
        self.register_buffer("n_updates", th.zeros((), dtype=th.long))
        if self.parts:
            self.register_buffer("accuracies", th.full((len(self.parts),), th.nan))
        #: (k, input_dim) which of the encoded action's inputs each part sees; ``None``: all.
        self.own_inputs: th.Tensor | None
        self.register_buffer("own_inputs", own_inputs(action_space, self.parts), persistent=False)
        # The gradient of the L2 term λ/2 ‖θ_E‖² is λ θ_E, which torch.optim calls weight decay.       # Eq. (7)
        self.optimizer = optimizer_class(
            self.parameters(),
            lr=learning_rate,  # type: ignore[call-arg]
            weight_decay=weight_decay,
            **self.optimizer_kwargs,
        )
        #: What is known of its fit: balanced "accuracy", and "statistics" of the observations' normalisation.
        self.about: dict[str, Any] = {}
        # Only a fit needs training mode; everything else queries E, sometimes for a single state.
        self.set_training_mode(False)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        """What ``save`` writes beside the weights, so that ``load`` builds the same network."""
        return {
            **super()._get_constructor_parameters(),
            **self._arguments,
            "optimizer_class": self.optimizer_class,
            "optimizer_kwargs": self.optimizer_kwargs,
            "features_extractor_class": self.features_extractor_class,
            "features_extractor_kwargs": self.features_extractor_kwargs,
        }

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments of the constructor but the spaces."""
        found = self._get_constructor_parameters()
        return {name: value for name, value in found.items() if not name.endswith("_space")}

    def features(self, obs: Any) -> th.Tensor:
        """(n, features_dim) features of n observation tensors."""
        return self.extract_features(obs, self.features_extractor)

    def logits(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """(n,) logits of (n, action_dim) scaled actions; above zero means permissible.

        With parts, an action is permissible unless a part that is accurate enough is not.
        """
        return self.of_all(self.part_logits(features, actions))

    def of_all(self, of_parts: th.Tensor) -> th.Tensor:
        """(n,) logits of the whole action from (n, k) of its parts."""
        if not self.parts:
            return of_parts.squeeze(1)
        return of_parts.masked_fill(~self.trusted, th.inf).min(dim=1).values

    def part_logits(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """(n, k) logits that each of k parts of the action is permissible, less the threshold's; without parts
        (n, 1).
        """
        return self.raw_logits(features, actions) - self.offset

    def raw_logits(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """(n, k) logits of the probabilities themselves; without parts (n, 1)."""
        if self.output_per_action:
            return self.head(features).gather(1, actions.reshape(-1, 1).long())  # type: ignore[no-any-return]
        # A float64 action space brings float64 actions.
        encoded = encoded_actions(self.action_space, actions).to(features.dtype)
        if self.own_inputs is None:
            return self.head(th.cat([features, encoded], dim=1))  # type: ignore[no-any-return]
        columns = [self._own_logits(features, encoded, number) for number in range(len(self.parts))]
        return th.stack(columns, dim=1)

    def _own_logits(self, features: th.Tensor, encoded: th.Tensor, part: Any) -> th.Tensor:
        """(n,) logits of one part, or of an (n,) tensor of parts, which sees its own inputs alone."""
        assert self.own_inputs is not None
        of_parts = self.head(th.cat([features, encoded * self.own_inputs[part]], dim=1))
        if isinstance(part, int):
            return of_parts[:, part]  # type: ignore[no-any-return]
        return of_parts.gather(1, part[:, None]).squeeze(1)  # type: ignore[no-any-return]

    @property
    def judged_parts(self) -> list[int]:
        """The parts whose output was fitted and validated; others have not been seen to err, or to be right."""
        return th.where(~self.accuracies.isnan())[0].tolist()

    @property
    def trusted(self) -> th.Tensor:
        """(k,) which parts are accurate enough, each as the whole action is without parts (section 4.3)."""
        return self.accuracies >= SUFFICIENT_ACCURACY

    def forward(self, obs: Any, actions: th.Tensor) -> th.Tensor:
        """(n,) logits of n observations and (n, action_dim) scaled actions."""
        return self.logits(self.features(obs), actions)
