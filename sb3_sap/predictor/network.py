"""The AP predictor E(s, a): a binary classifier that predicts permissibility (section 4.2)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import obs_as_tensor
from torch.nn import functional as F

from sb3_sap.common.arrays import FloatArray, Observations
from sb3_sap.common.torch_utils import flush_denormals, own_generators
from sb3_sap.common.vec_envs import policy_layout
from sb3_sap.predictor.encoding import encoded_actions
from sb3_sap.predictor.judging import JudgingNetwork
from sb3_sap.predictor.knowledge import LabelledActions
from sb3_sap.predictor.weights import read_predictor, write_predictor


class PermissibilityPredictor(JudgingNetwork):
    """E(s, a | θ_E): the logit that action a is permissible in state s.

    Its inputs are observations as the policy gets them, and actions scaled to [-1, 1], or one-hot if they are discrete
    (in each dimension of a ``MultiDiscrete``); those of a ``MultiBinary`` are as they are.

    With ``action_parts`` it has an output for each of k parts of the action, over shared layers. Of a ``Box`` each sees
    the whole action; of a ``MultiDiscrete`` or ``MultiBinary`` its own dimensions alone, the others being zeros, so
    that it judges the part by itself. The logit of the action is then the lowest of the parts that are accurate enough.

    :param observation_space: of the environment
    :param action_space: of the environment
    :param net_arch: hidden layers; the paper's are 128 and 256
    :param activation_fn: between them
    :param learning_rate: of its optimizer
    :param weight_decay: λ of Eq. (7)
    :param batch_size: of one gradient step
    :param optimizer_class: a ``torch.optim`` class or its name, such as ``"SGD"``
    :param optimizer_kwargs: its further arguments
    :param features_extractor_class: as in SB3's policies; E owns its extractor
    :param features_extractor_kwargs: its arguments
    :param normalize_images: as in SB3's policies
    :param action_parts: names of parts of the action with their dimensions, which have labels of their own
    :param output_per_action: for ``Discrete`` actions, whether E has an output for each action instead of an input, so
        that one pass judges all of them, which is far faster for hundreds
    :param threshold: probability, between 0 and 1, above which an action counts as permissible
    """

    def save(self, path: str | Path) -> None:
        """Writes weights, architecture and spaces as plain data."""
        write_predictor(self, path)

    @classmethod
    def load(cls, path: str | Path, device: th.device | str = "auto", **arguments: Any) -> Self:
        """Reads what :meth:`save` wrote. Nothing in the file is executed, so that it may come from a stranger.

        :param arguments: of the constructor, in place of those in the file: a ``features_extractor_class``,
            ``activation_fn`` or ``optimizer_class`` of your own must be passed
        :raise ValueError: with one sentence, if the file holds no predictor
        """
        return read_predictor(cls, path, device, **arguments)  # type: ignore[no-any-return]

    def probabilities(self, obs: Observations, actions: np.ndarray[Any, Any]) -> FloatArray:
        """(n,) probabilities that n actions are permissible; with k parts of the action, (n, k).

        :param obs: (n, *obs_shape), as the policy gets them: normalised if it learned so
        :param actions: (n, *action_shape), in the environment's units
        """
        scaled = np.asarray(actions)
        if isinstance(self.action_space, spaces.Box):
            low, high = self.action_space.low, self.action_space.high
            scaled = 2.0 * (scaled - low) / (high - low) - 1.0
        with th.no_grad():
            tensor = th.as_tensor(scaled.reshape(len(scaled), -1), device=self.device)
            features = self.features(obs_as_tensor(policy_layout(obs, self.observation_space), self.device))
            found = th.sigmoid(self.raw_logits(features, tensor)).cpu().numpy()
        return found if self.parts else found[:, 0]

    @property
    def fitted(self) -> bool:
        """Whether E has seen any example; Algorithm 1 does not query it before."""
        return bool(self.n_updates)

    def loss(self, obs: Any, actions: th.Tensor, labels: th.Tensor, weights: th.Tensor | None = None) -> th.Tensor:
        """Binary cross-entropy of (n,) labels from 0 to 1, or of those that are known of (n, k); the optimizer adds the
        L2 term.

        :param weights: (n,) how much each row counts; ``None``: all the same
        """
        features = self.features(obs)
        if not self.parts:
            logits = self.raw_logits(features, actions).squeeze(1)
            return F.binary_cross_entropy_with_logits(logits, labels, weights)  # Eq. (7)
        known = ~labels.isnan()
        if self.own_inputs is None:
            found = self.raw_logits(features, actions)[known]
        else:  # of each row the parts alone that it has labels of
            rows, numbers = known.nonzero(as_tuple=True)
            encoded = encoded_actions(self.action_space, actions).to(labels.dtype)
            found = self._own_logits(features[rows], encoded[rows], numbers)
        return F.binary_cross_entropy_with_logits(found, labels[known])

    @flush_denormals()
    def fit(self, dataset: LabelledActions, weights: FloatArray | None = None) -> float:
        """One pass of mini-batch gradient descent over D_E, whose rows are in random order.

        :param weights: (n,) how much each row counts, where the action has no parts; ``None``: all the same
        :return: mean loss over the mini-batches
        """
        obs, actions, labels = self._to_tensors(dataset)
        weighing = None if weights is None else th.as_tensor(weights, device=self.device)
        losses = []
        with self._training():
            for batch in self._batches(len(labels)):
                obs_batch = {key: value[batch] for key, value in obs.items()} if isinstance(obs, dict) else obs[batch]
                loss = self.loss(
                    obs_batch, actions[batch], labels[batch], None if weighing is None else weighing[batch]
                )
                self.optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                self.optimizer.step()
                losses.append(loss.item())
        self.n_updates += len(losses)
        return float(np.mean(losses))

    @contextmanager
    def _training(self) -> Iterator[None]:
        """Training mode within the block; random layers do not touch the global generators."""
        with own_generators((self._seed + int(self.n_updates)) % 2**63, self.device):
            self.set_training_mode(True)
            try:
                yield
            finally:
                self.set_training_mode(False)

    def _batches(self, n: int) -> Iterator[slice]:
        """Mini-batches of n rows."""
        starts = list(range(0, n, self.batch_size))
        if self._normalises_batches and n % self.batch_size == 1 and len(starts) > 1:
            starts.pop()  # a single row has no variance, so it joins the batch before it
        for start, end in zip(starts, [*starts[1:], n], strict=True):
            yield slice(start, end)

    @th.no_grad()
    @flush_denormals()
    def recall(self, dataset: LabelledActions) -> tuple[float, float]:
        """E's recall of each class, (non-permissible, permissible); their mean is the balanced accuracy.

        With parts, the means over those that the dataset has labels of, whose accuracies are noted.
        """
        obs, actions, labels = self._to_tensors(dataset)
        of_parts = self.part_logits(self.features(obs), actions)
        labels = labels.reshape(of_parts.shape)
        recalls = []
        for number in th.where(~labels.isnan().all(dim=0))[0].tolist():
            known = ~labels[:, number].isnan()
            permissible = labels[known, number] > 0.5
            correct = ((of_parts[known, number] > 0) == permissible).double()
            recalls.append((correct[~permissible].mean().item(), correct[permissible].mean().item()))
            if self.parts:
                self.accuracies[number] = sum(recalls[-1]) / 2
        non_permissible, of_permissible = np.mean(recalls, axis=0)
        return float(non_permissible), float(of_permissible)

    def _to_tensors(self, dataset: LabelledActions) -> tuple[Any, th.Tensor, th.Tensor]:
        obs: Any = obs_as_tensor(dataset.observations, self.device)
        actions, labels = (th.as_tensor(array, device=self.device) for array in dataset[1:])
        return obs, actions, labels
