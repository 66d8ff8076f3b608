"""Studies that several workers share: their storage, their random seeds, and which worker runs which trial."""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.distributions import BaseDistribution
from optuna.samplers import BaseSampler
from optuna.storages import BaseStorage, JournalStorage, RetryHeartbeatStaleTrialCallback
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.exc import SQLAlchemyError

#: Number of times that a trial is run again after its worker died.
MAX_RETRIES = 3
#: States of trials that count for ``--max-total-trials``: what is finished, runs, or waits to be run.
LIVE = (TrialState.COMPLETE, TrialState.PRUNED, TrialState.RUNNING, TrialState.WAITING)
FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)


def open_storage(storage: str | None, heartbeat: int | None = None) -> BaseStorage | None:
    """Opens what ``--storage`` names: a Journal file ``….log``, a proxy ``grpc://host:port``, or a database URL.

    :param heartbeat: time between two signs of life of a database's workers, s
    """
    if storage is None:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        if storage.endswith(".log"):
            Path(storage).parent.mkdir(parents=True, exist_ok=True)
            return JournalStorage(JournalFileBackend(storage))
        if storage.startswith("grpc://"):
            host, _, port = storage.removeprefix("grpc://").partition(":")
            if not port.isdigit():
                raise ValueError(f"`--storage` {storage} names no port: write grpc://host:13000.")
            return optuna.storages.GrpcStorageProxy(host=host, port=int(port))
        if "://" not in storage:
            raise ValueError(
                f"`--storage` {storage!r} is neither a database URL (sqlite:///study.db), nor a Journal file "
                "(study.log), nor a proxy (grpc://host:port)."
            )
        return _open_database(storage, heartbeat)


def _open_database(url: str, heartbeat: int | None, attempts: int = 10) -> BaseStorage:
    retry = RetryHeartbeatStaleTrialCallback(max_retry=MAX_RETRIES) if heartbeat else None
    try:
        return optuna.storages.RDBStorage(url, heartbeat_interval=heartbeat, heartbeat_stale_trial_callback=retry)
    except (SQLAlchemyError, optuna.exceptions.StorageInternalError) as error:
        # Workers that begin together all create the tables of a new database, and all but one of them fail.
        if "already exists" in str(error) and attempts > 1:
            time.sleep(1)
            return _open_database(url, heartbeat, attempts - 1)
        reason = str(error).splitlines()[0]
        raise OSError(f"`--storage` {without_password(url)} cannot be opened: {reason}") from error


def without_password(text: str) -> str:
    """A text in which the passwords of database URLs are masked."""
    return re.sub(r"(://[^:/@\s]+):[^@\s]+@", r"\1:***@", text)


def load_study(storage: str, study_name: str) -> optuna.Study:
    """Loads a study that must exist."""
    opened: Any = open_storage(storage)
    try:
        return optuna.load_study(study_name=study_name, storage=opened)
    except KeyError as error:
        names = optuna.get_all_study_names(opened)
        known = f"it holds {', '.join(map(repr, names))}" if names else "it is empty"
        raise ValueError(f"There is no study {study_name!r} in {without_password(storage)}: {known}.") from error


def check_belongs(study: optuna.Study, algo: str, env_id: str) -> None:
    """Checks that a study is one of this algorithm and environment."""
    found = study.user_attrs.get("algo", algo), study.user_attrs.get("env", env_id)
    if found != (algo, env_id):
        raise ValueError(
            f"The study {study.study_name!r} is one of {found[0]} on {found[1]}, not of {algo} on {env_id}: give "
            "another `--study-name`."
        )


def reap(study: optuna.Study) -> None:
    """Gives up the trials of workers that died, which are then waiting to be run again."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        optuna.storages.fail_stale_trials(study)


def is_surplus(study: optuna.Study, number: int, max_total_trials: int) -> bool:
    """Whether ``max_total_trials`` trials or more have lower numbers than this one.

    Two workers may each begin what both take for the last trial. Numbers are given by the storage, so that all workers
    agree which of the two is one too many.
    """
    earlier = [t for t in study.get_trials(deepcopy=False, states=LIVE) if t.number < number]
    return len(earlier) >= max_total_trials


class SeededByTrial(BaseSampler):
    """Draws every trial from a generator of its own, which the study's seed and the trial's number determine.

    A study can thus be repeated, whichever worker runs which trial, and no two workers draw the same numbers.

    :param make: the sampler that draws, from a seed
    :param seed: of the study
    """

    def __init__(self, make: Callable[[int], BaseSampler], seed: int):
        self._make = make
        self._seed = seed
        self._samplers: dict[int, BaseSampler] = {}

    def _of(self, trial: FrozenTrial) -> BaseSampler:
        if trial.number not in self._samplers:
            [seed] = np.random.SeedSequence([self._seed, trial.number]).generate_state(1)
            self._samplers[trial.number] = self._make(int(seed))
        return self._samplers[trial.number]

    def infer_relative_search_space(self, study: optuna.Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        return self._of(trial).infer_relative_search_space(study, trial)

    def sample_relative(
        self, study: optuna.Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        return self._of(trial).sample_relative(study, trial, search_space)

    def sample_independent(
        self, study: optuna.Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        return self._of(trial).sample_independent(study, trial, param_name, param_distribution)

    def before_trial(self, study: optuna.Study, trial: FrozenTrial) -> None:
        self._of(trial).before_trial(study, trial)

    def after_trial(self, study: optuna.Study, trial: FrozenTrial, state: TrialState, values: Any) -> None:
        self._of(trial).after_trial(study, trial, state, values)
        self._samplers.pop(trial.number, None)
