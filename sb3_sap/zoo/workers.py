"""Several workers on one study: how one of them goes on until all trials are finished."""

from __future__ import annotations

import time
from collections.abc import Callable

import optuna
from optuna.trial import TrialState

from sb3_sap.zoo.storages import FINISHED, LIVE, reap

#: s between two looks at the trials of other workers.
POLL = 2.0


class SurplusTrial(Exception):
    """Another worker began the last trial of the study at the same moment."""


def work_until(
    study: optuna.Study, objective: Callable[[optuna.Trial], float], max_total_trials: int, n_jobs: int
) -> None:
    """Runs trials until that many are finished, by whichever worker; those of workers that died are run again.

    :param n_jobs: trials side by side in this worker; below 1, all that are missing
    """
    told = False
    while True:
        reap(study)
        trials = study.get_trials(deepcopy=False, states=LIVE)
        if sum(trial.state in FINISHED for trial in trials) >= max_total_trials:
            return
        waiting = any(trial.state == TrialState.WAITING for trial in trials)
        if waiting or len(trials) < max_total_trials:
            missing = max(1, max_total_trials - len(trials))
            side_by_side = min(n_jobs if n_jobs > 0 else missing, missing)
            study.optimize(
                objective, n_trials=side_by_side, n_jobs=side_by_side, catch=(SurplusTrial,), gc_after_trial=True
            )
            continue
        if not told:
            told = True
            running = [trial.number for trial in trials if trial.state == TrialState.RUNNING]
            print(f"Waiting for trials {running} of other workers, in case one of them dies.")
        time.sleep(POLL)
