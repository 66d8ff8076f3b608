"""Acting by whatever has SB3's ``predict``, with the memory of a recurrent policy."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_sap.common.arrays import BoolArray


class Actor:
    """Acts deterministically, and remembers from step to step what a recurrent policy gives back.

    A policy of sb3-contrib's RecurrentPPO that is not given its memory begins anew at every step, silently. A policy
    without memory, or a controller, is called with the observation alone.

    :param policy: a model, a policy or a controller with ``predict``
    """

    def __init__(self, policy: Any):
        self.policy = policy
        self._memory: tuple[np.ndarray[Any, Any], ...] | None = None

    def __call__(self, obs: Any, starts: Any = False) -> Any:
        """The action for one observation, or those for a batch of them.

        :param starts: whether an episode begins with the observation, (n,) for a batch
        """
        if self._memory is None:
            given = self.policy.predict(obs, deterministic=True)
        else:
            n_envs = self._memory[0].shape[1]
            starts = np.broadcast_to(np.asarray(starts, dtype=bool), n_envs)
            given = self.policy.predict(obs, state=self._memory, episode_start=starts, deterministic=True)
        if not isinstance(given, tuple):
            return given
        actions, self._memory = given
        return actions

    def keep(self, going: BoolArray) -> None:
        """Forgets the rows of a batch, (n,), that do not go on."""
        if self._memory is not None:
            self._memory = tuple(part[:, going] for part in self._memory)
