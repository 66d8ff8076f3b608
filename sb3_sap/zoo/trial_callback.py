"""The evaluations that a trial reports to Optuna while it runs."""

from __future__ import annotations

from rl_zoo3.callbacks import TrialEvalCallback

from sb3_sap.guidance.mixin import ActionPermissibilityMixin


class ReportingCallback(TrialEvalCallback):
    """Reports evaluations by training step, prunes only once E guides, and always ends with an evaluation."""

    def _on_step(self) -> bool:
        if self.n_calls % self.eval_freq != 0:
            return True
        self._report()
        if self._guided() and self.trial.should_prune():
            self.is_pruned = True
        return not self.is_pruned

    def _on_training_end(self) -> None:
        if not self.is_pruned and self.n_calls % self.eval_freq != 0:
            self._report()

    def _report(self) -> None:
        # EvalCallback evaluates at multiples of its frequency: with 1 it does so now.
        frequency, self.eval_freq = self.eval_freq, 1
        super(TrialEvalCallback, self)._on_step()
        self.eval_freq = frequency
        self.trial.report(self.last_mean_reward, self.num_timesteps)

    def _guided(self) -> bool:
        model = self.model
        if not isinstance(model, ActionPermissibilityMixin):
            return True
        return model.predictor.fitted and self.num_timesteps > model.noise_steps
