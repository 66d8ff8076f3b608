"""Bias and noise of the policy gradient of PPOAP's continuous actions, on a bandit whose gradient is known.

python measurements/continuous_choice.py   # writes results/continuous_choice.md, in half a minute

The policy is a normal distribution with the mean μ, E permits actions above 0, and the reward is -(a - 0.9)². What is
executed is the first of N draws that E permits, or the first draw where it permits none. Its density and the gradient
of its expected reward with respect to μ follow in closed form. The estimates are those of the first gradient step of
PPO, where the ratio is 1; PPOAP uses the last one.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from scipy.stats import norm
from stable_baselines3.common.distributions import DiagGaussianDistribution

from sb3_sap.onpolicy.draws import DrawingGuide
from sb3_sap.onpolicy.known import KnownMasks

SIGMA, BEST, SAMPLES = 0.5, 0.9, 400_000
#: Shares of the policy's actions that E permits, numbers of draws, and errors of the value in standard deviations.
SHARES, DRAWS, ERRORS = (0.9, 0.5, 0.1), (1, 8, 32), (0.0, 0.5, -0.5)


class Above:
    """An E that permits actions above 0."""

    def features(self, obs: th.Tensor) -> th.Tensor:
        return obs

    def logits(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        return actions[:, 0]


def expected_reward(mean: float, n: int) -> float:
    """Of what is executed, by quadrature."""
    actions = np.linspace(mean - 8 * SIGMA, mean + 8 * SIGMA, 400_001)
    density, permitted = norm.pdf(actions, mean, SIGMA), actions > 0
    share = norm.cdf(mean / SIGMA)
    none = (1 - share) ** n
    weight = np.where(permitted, (1 - none) / share, none / (1 - share))
    return float(np.trapezoid(density * weight * reward(actions), actions))


def reward(actions: np.ndarray) -> np.ndarray:
    """Of what the environment executes: the action, clipped to its box."""
    return -((np.clip(actions, -1, 1) - BEST) ** 2)


def estimates(mean: float, n: int, error: float, rng: np.random.Generator) -> dict[str, tuple[float, float]]:
    """Mean and standard deviation of each estimate of the gradient, from one action."""
    space = spaces.Box(-1, 1, (1,))
    judge: Any = Above()
    settings: dict[str, Any] = {
        "n_candidates": n,
        "squashed": False,
        "predicts": True,
    }  # which keeps no draws for an update
    guide = DrawingGuide(judge, space, KnownMasks([]), th.device("cpu"), **settings)
    distribution = DiagGaussianDistribution(1).proba_distribution(
        th.full((SAMPLES, 1), mean), th.full((SAMPLES, 1), float(np.log(SIGMA)))
    )
    actions = guide.first_permissible(th.zeros(SAMPLES, 1), distribution)[:, 0].numpy().astype(float)
    rewards = reward(actions)
    advantage = rewards - rewards.mean() + error * rewards.std()
    score = (actions - mean) / SIGMA**2
    share = norm.cdf(mean / SIGMA)
    exact = norm.pdf(mean / SIGMA) / SIGMA / share  # ∇ log Z
    # An estimate of ∇ log Z from N draws is the mean score of those that are permitted.
    drawn = rng.normal(mean, SIGMA, (SAMPLES, n))
    counts = (drawn > 0).sum(axis=1)
    estimated = np.where(drawn > 0, (drawn - mean) / SIGMA**2, 0).sum(axis=1) / np.maximum(counts, 1)
    found = {
        "log π": advantage * score,
        "log π − log Z, Z exact": advantage * (score - exact),
        "log π − log Z, Z from the draws": advantage * (score - estimated),
    }
    return {name: (float(values.mean()), float(values.std())) for name, values in found.items()}


def main() -> None:
    """Writes the table."""
    th.manual_seed(0)
    rng, rows = np.random.default_rng(0), []
    for share in SHARES:
        mean = SIGMA * norm.ppf(share)
        for n in DRAWS:
            gradient = (expected_reward(mean + 1e-3, n) - expected_reward(mean - 1e-3, n)) / 2e-3
            for error in ERRORS if n == DRAWS[-1] else ERRORS[:1]:
                found = estimates(mean, n, error, rng)
                cells = [f"{(m - gradient) / abs(gradient):+.1%} ({s / abs(gradient):.1f})" for m, s in found.values()]
                rows.append(f"| {share:.0%} | {n} | {error:+g} | {gradient:.3f} | " + " | ".join(cells) + " |")
    names = list(found)
    text = "\n".join(
        [
            "# The gradient of a guided continuous policy",
            "",
            "The problem is in `measurements/continuous_choice.py`, which makes this table. Each cell has the relative "
            "error of the expected estimate, and in brackets the standard deviation of an estimate from one action, "
            "relative to the gradient.",
            "",
            f"| permitted | draws | error of the value | gradient | {' | '.join(names)} |",
            "| --- | --- | --- | --- | " + " | ".join("---" for _ in names) + " |",
            *rows,
            "",
        ]
    )
    (Path(__file__).parent.parent / "results" / "continuous_choice.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
