"""Conduct of studies: Optuna chooses the settings of trials, jobs train with them, their results go back to Optuna.

Optuna's tables hold what the sampler knows; each of its trials gets one row in `trials`, with at most one job, in one
transaction. Every pass compares the two, so whatever an interrupted pass left behind is completed by the next one, by
this worker or another: a trial without a row gets its job, a trial whose job has ended is reported once, and a row
without a trial, as after a restore, gives Optuna its trial again.
"""

from __future__ import annotations

import hashlib
import json
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from naojobs import requests, studies
from naojobs.checkpoints import newest_checkpoint
from naojobs.connections import bounds
from naojobs.database import Sessions, is_outage
from naojobs.errors import InvalidError
from naojobs.ids import same_id
from naojobs.models import Evaluation, Job, MetricsRecord, Study, StudyState, Trial, TrialState
from naojobs.states import ENDED, WorkState
from naojobs.submission import JobRequest, add_job
from naospec import TrainingSpec, validation_words
from naospec.search import Choices, IntRange, Parameter, Pruning, SearchSpec
from pydantic import ValidationError
from sqlalchemy import func, select, text
from sqlalchemy.orm import Session

from naosprint_worker import population
from naosprint_worker.database import outage_of
from naosprint_worker.population import Start
from naosprint_worker.retry import describe

# Optuna takes a second to load and most workers never conduct a study.
if TYPE_CHECKING:
    import optuna

logger = logging.getLogger(__name__)

SCHEMA = "optuna"
"""Schema of Optuna's tables, apart from ours."""
STARTS_PER_PASS = 4
"""Trials that one pass starts, so that its transaction stays short."""
IMPORTANCE_FROM = 5
"""Complete trials from which importances are computed."""

_TABLES_LOCK = 0x6F7074
"""Key of the lock against two creations of Optuna's tables at once."""


class Conductor:
    """Conductor of all running studies; any number of workers may have one."""

    def __init__(self, sessions: Sessions, database_url: str) -> None:
        self._sessions = sessions
        self._url = database_url
        self._storage: optuna.storages.BaseStorage | None = None

    def advance_all(self) -> bool:
        """Advance every running study by one pass; return whether jobs were queued.

        One that cannot be advanced fails, and one for which the database fails continues with the next pass; neither
        keeps others from advancing. A database that does not answer ends the pass. Each pass has an order of its own,
        so that a study that brings this about keeps no others waiting for good.
        """
        with self._sessions() as session:
            running = session.scalars(
                select(Study.id).where(Study.state == StudyState.RUNNING).order_by(func.random())
            ).all()
        queued = False
        for study_id in running:
            with _alone(study_id):
                queued = self._advance_or_end(study_id) or queued
        return queued

    def _advance_or_end(self, study_id: str) -> bool:
        """Advance a study, or end one that cannot be advanced; return whether jobs were queued."""
        try:
            return self.advance(study_id)
        except Exception as error:
            if outage_of(error) is not None:
                raise
            logger.exception("study %s cannot be advanced", study_id)
            self._give_up(study_id, error)
        return False

    def _give_up(self, study_id: str, error: Exception) -> None:
        """End a study that cannot be advanced; it can be extended when the reason is gone."""
        why = describe(error, 500)
        if isinstance(error, ValidationError):
            why = f"it does not fit this version: {validation_words(error.errors())}"
        with self._sessions.begin() as session:
            running = (Study.id == study_id, Study.state == StudyState.RUNNING)
            study = session.scalar(select(Study).where(*running).with_for_update())
            if study is not None:
                studies.end(session, study, StudyState.FAILED, why)

    def advance(self, study_id: str) -> bool:
        """Report what has ended, prune what falls behind and start what is missing; return whether jobs were queued.

        A study that another worker is advancing is left to it.
        """
        storage = self._optuna()
        with self._sessions.begin() as session:
            running = (Study.id == study_id, Study.state == StudyState.RUNNING)
            study = session.scalar(select(Study).where(*running).with_for_update(skip_locked=True))
            if study is None:
                return False
            behind, queued = _Pass(session, study, storage).run()
        for job_id, why in behind.items():
            requests.prune(self._sessions, job_id, why)
        return queued

    def forget_deleted(self) -> None:
        """Delete what Optuna holds of studies that were deleted."""
        with self._sessions() as session:
            if session.scalar(text("SELECT to_regclass('optuna.studies')")) is None:
                return
        # Optuna's come first: the row of a study that begins meanwhile is there before Optuna holds anything of it.
        held = self._optuna().get_all_studies()
        with self._sessions() as session:
            known = set(session.scalars(select(Study.id)))
        for study in held:
            if study.study_name not in known:
                with _alone(study.study_name), suppress(KeyError):  # another worker was faster
                    self._optuna().delete_study(study._study_id)
                    logger.info("deleted what Optuna holds of %s", study.study_name)

    def _optuna(self) -> optuna.storages.BaseStorage:
        """Return Optuna's storage; its tables are made on first use."""
        if self._storage is None:
            with _quiet():
                import optuna
                from sqlalchemy.pool import NullPool

                optuna.logging.set_verbosity(optuna.logging.WARNING)
                options = {"options": f"-c search_path={SCHEMA} -c timezone=UTC -c statement_timeout=30000"}
                engine = {"poolclass": NullPool, "connect_args": {**options, **bounds(self._url)}}
                with self._sessions.begin() as session:
                    session.execute(select(func.pg_advisory_xact_lock(_TABLES_LOCK)))
                    tables = optuna.storages.RDBStorage(self._url, engine_kwargs=engine)
                self._storage = optuna.storages.get_storage(tables)
        return self._storage


@contextmanager
def _alone(study: str) -> Iterator[None]:
    """Log an error, so that it stops no other study; raise that of a database that does not answer."""
    try:
        yield
    except Exception as error:
        cause = outage_of(error) or error
        if is_outage(cause):
            raise cause from cause.__cause__  # the driver's
        logger.warning("study %s waits for the database: %s", study, describe(cause))


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress warnings about parts of Optuna that may change: its version is pinned."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


class _Pass:
    """One pass over a locked study."""

    def __init__(self, session: Session, study: Study, storage: optuna.storages.BaseStorage) -> None:
        import optuna

        self._session = session
        self._row = study
        self._search = SearchSpec.model_validate(study.spec)
        self._rows = {trial.number: trial for trial in studies.trials_of(session, study.id)}
        job_ids = [trial.job_id for trial in self._rows.values() if trial.job_id is not None]
        self._jobs = {job.id: job for job in session.scalars(select(Job).where(Job.id.in_(job_ids)))}
        parts: dict[str, Any] = {
            "storage": storage,
            "study_name": study.id,
            "sampler": self._sampler(),
            "pruner": _pruner(self._search.pruning),
        }
        with _quiet():
            try:
                self._study = optuna.load_study(**parts)
            except KeyError:  # a creation of one that is there takes an id and is an error in the server's log
                directions = [objective.direction or "maximize" for objective in self._search.objectives]
                self._study = optuna.create_study(directions=directions, load_if_exists=True, **parts)

    def run(self) -> tuple[dict[str, str], bool]:
        """Return the jobs to prune with the reasons, and whether jobs were queued."""
        from optuna.trial import TrialState as Told

        with _quiet():
            self._give_back()
            frozen = {trial.number: trial for trial in self._study.get_trials(deepcopy=False)}
            behind: dict[str, str] = {}
            ended = False
            for row in self._rows.values():
                if row.state is TrialState.RUNNING:
                    reason = self._settle(row, frozen[row.number])
                    ended = ended or row.state is not TrialState.RUNNING
                    if reason and row.job_id is not None:
                        behind[row.job_id] = reason
                elif not frozen[row.number].state.is_finished():  # of a study that was ended, and then extended
                    self._study.tell(row.number, state=Told.FAIL, skip_if_finished=True)
            if ended:
                self._row.importance = self._importance()
            queued = not self._finish() and self._start(frozen)
        return behind, queued

    def _give_back(self) -> None:
        """Add the trials that have rows and that Optuna lacks: a backup contains no tables of Optuna."""
        import optuna

        theirs = optuna.trial.TrialState
        held = len(self._study.get_trials(deepcopy=False))
        space = {name: _distribution(item) for name, item in self._search.space.items()}
        for number in range(held, max(self._rows, default=-1) + 1):  # Optuna numbers in the order of addition
            row = self._rows.get(number)
            if row is None:
                self._study.add_trial(optuna.trial.create_trial(state=theirs.FAIL))
                continue
            job = self._jobs.get(row.job_id or "")
            compared = job is not None and self._search.pruning.name != "none"
            means = self._interval_means(job, after=0) if job is not None and compared else {}
            self._study.add_trial(
                optuna.trial.create_trial(
                    state=theirs.FAIL if row.state is TrialState.FAILED else theirs[row.state.name],
                    values=row.values if row.state is TrialState.COMPLETE else None,
                    params={name: _stored(self._search.space[name], value) for name, value in row.params.items()},
                    distributions={name: space[name] for name in row.params},
                    intermediate_values={interval: self._factor * mean for interval, mean in means.items()},
                )
            )

    # Results

    def _settle(self, row: Trial, frozen: optuna.trial.FrozenTrial) -> str | None:
        """Bring a trial up to date; return why it is to be pruned, if it is."""
        from optuna.trial import TrialState as Told

        job = self._jobs.get(row.job_id or "")
        if not frozen.state.is_finished():
            values, error = None, None
            if self._search.elsewhere:
                if row.values is None and row.error is None:
                    return None
                values, error = row.values, row.error
                state = Told.COMPLETE if values is not None else Told.FAIL
            elif job is None:
                state, error = Told.FAIL, "its job was deleted"
            elif job.state not in ENDED:
                return self._compare(frozen, job)
            elif job.state is WorkState.SUCCEEDED:
                values, error = self._values(job)
                state = Told.COMPLETE if values is not None else Told.FAIL
            elif job.state is WorkState.CANCELLED and job.pruned:
                state = Told.PRUNED
            else:
                state, error = Told.FAIL, job.error or f"its job was {job.state}"
            if job is not None:  # others are compared with its last intervals, too
                self._report(frozen, job)
            # Another pass may have reported it without getting to its row: that report counts.
            frozen = self._study.tell(row.number, values, state=state, skip_if_finished=True)
            row.error = error
        row.state = {Told.COMPLETE: TrialState.COMPLETE, Told.PRUNED: TrialState.PRUNED}.get(
            frozen.state, TrialState.FAILED
        )
        row.values = list(frozen.values) if row.state is TrialState.COMPLETE else None
        if row.state is TrialState.PRUNED and job is not None:
            row.error = job.pruned
        row.finished_at = func.now()
        return None

    def _values(self, job: Job) -> tuple[list[float] | None, str | None]:
        """Return the objectives' values of a job that succeeded, or why there are none."""
        results: dict[str, float | None] = {}
        if job.evaluation is not None:
            checkpoint = newest_checkpoint(self._session, job.id)
            # The evaluation at the end of a job has the digits of its last checkpoint (`naosprint_worker.trainer`).
            evaluation = checkpoint and self._session.get(Evaluation, same_id("eval", checkpoint.id))
            if not evaluation or evaluation.summary is None:
                return None, "its evaluation was deleted"
            results = {result["name"]: result["value"] for result in evaluation.summary["results"]}
        values = []
        for objective in self._search.objectives:
            name = objective.metric
            value = results[name] if name in results else job.latest_metrics.get(name)
            if value is None:
                return None, f"it has no {name}: no episode counts for it, or it is no finite number"
            values.append(float(value))
        return values, None

    def _compare(self, frozen: optuna.trial.FrozenTrial, job: Job) -> str | None:
        """Report the live metrics of an open trial; return why it is to be pruned, if it is."""
        if job.state is not WorkState.RUNNING or job.cancel_requested:
            return None
        trial = self._report(frozen, job)
        if trial is None or not trial.should_prune():
            return None
        pruning = self._search.pruning
        known = self._study.get_trials(deepcopy=False)[trial.number].intermediate_values
        last = max(known)
        steps, mean = last * (pruning.interval_steps or 1), self._factor * known[last]
        return f"{pruning.metric} was {mean:.4g} up to step {steps:,}, behind other trials ({pruning.name} pruning)"

    def _report(self, frozen: optuna.trial.FrozenTrial, job: Job) -> optuna.trial.Trial | None:
        """Report new intervals of the pruning metric; return the trial, or none if trials are not compared."""
        import optuna

        if self._search.pruning.name == "none":
            return None
        trial = optuna.trial.Trial(self._study, frozen._trial_id)
        for interval, mean in self._interval_means(job, after=max(frozen.intermediate_values, default=0)).items():
            trial.report(self._factor * mean, interval)
        return trial

    @property
    def _factor(self) -> float:
        """Factor of the pruning metric: Optuna compares by the objective's direction."""
        return 1.0 if self._search.pruning.direction == self._search.objectives[0].direction else -1.0

    def _interval_means(self, job: Job, *, after: int) -> dict[int, float]:
        """Return the means of the pruning metric by interval, numbered from 1, of the complete ones behind `after`."""
        pruning = self._search.pruning
        length = pruning.interval_steps or 1
        steps = MetricsRecord.step
        number = (steps + length - 1) // length
        statement = (
            select(number.label("number"), func.avg(MetricsRecord.values[pruning.metric].as_float()))
            .where(
                MetricsRecord.job_id == job.id, steps > after * length, steps <= job.progress_step // length * length
            )
            .where(MetricsRecord.values.has_key(pruning.metric))
            .group_by("number")
            .order_by("number")
        )
        return {int(interval): float(mean) for interval, mean in self._session.execute(statement)}

    def _importance(self) -> dict[str, Any]:
        """Return the importance of each setting by objective, once enough trials are complete."""
        from optuna.importance import get_param_importances
        from optuna.trial import TrialState as Told

        complete = self._study.get_trials(deepcopy=False, states=(Told.COMPLETE,))
        if len(complete) < IMPORTANCE_FROM or len(self._search.space) < 2:
            return {}
        importance = {}
        for index, objective in enumerate(self._search.objectives):
            factor = -1.0 if objective.direction == "maximize" else 1.0

            def target(trial: optuna.trial.FrozenTrial, index: int = index, factor: float = factor) -> float:
                return factor * float(trial.values[index])

            if len({trial.values[index] for trial in complete}) > 1:
                importance[objective.metric] = get_param_importances(self._study, target=target)
        return importance

    # Trials

    def _finish(self) -> bool:
        """End the study if it is over; return whether it is."""
        rows = sorted(self._rows.values(), key=lambda trial: trial.number)
        states = [trial.state for trial in rows]
        if len(states) >= self._search.trials and TrialState.RUNNING not in states:
            studies.end(self._session, self._row, StudyState.FINISHED, "all trials have ended")
            return True
        over = [
            trial for trial in rows if trial.state is not TrialState.RUNNING and trial.number >= self._row.extended_at
        ]
        latest = over[-studies.MAX_FAILURES_IN_A_ROW :]
        if len(latest) == studies.MAX_FAILURES_IN_A_ROW and all(t.state is TrialState.FAILED for t in latest):
            why = f"{len(latest)} trials in a row failed; the last one: {latest[-1].error}"
            studies.end(self._session, self._row, StudyState.FAILED, why)
            return True
        return False

    def _start(self, frozen: Mapping[int, optuna.trial.FrozenTrial]) -> bool:
        """Queue jobs for trials that are missing; return whether there are new ones."""
        import optuna

        free = self._search.parallel - sum(row.state is TrialState.RUNNING for row in self._rows.values())
        # Those that an interrupted pass asked for come first.
        left = [number for number in frozen if number not in self._rows]
        queued = False
        for _ in range(min(free, STARTS_PER_PASS, self._search.trials - len(self._rows))):
            begun = Start(None, {})
            if self._search.sampler == "population":
                number = left[0] if left else max([*frozen, *self._rows], default=-1) + 1
                if not population.is_due(self._search, self._rows, number):
                    break
                begun = population.start_of(self._search, self._rows, number)
                given = {name: _stored(self._search.space[name], value) for name, value in begun.params.items()}
                self._study.sampler = optuna.samplers.PartialFixedSampler(given, self._sampler())
            trial = optuna.trial.Trial(self._study, frozen[left.pop(0)]._trial_id) if left else self._study.ask()
            # A setting that an interrupted pass has chosen keeps its value.
            params = {name: _suggest(trial, name, item) for name, item in self._search.space.items()}
            self._add(trial.number, params, begun.parent)
            queued = True
        return queued

    def _add(self, number: int, params: dict[str, Any], parent: Trial | None) -> None:
        row = Trial(study_id=self._row.id, number=number, state=TrialState.RUNNING, params=params)
        try:
            request = studies.trial_job(studies.job_of(self._row), params)
            if parent is not None:  # the environments are to differ from those that its policy was trained in
                seed = request.spec.seed + number // self._search.population
                request = replace(
                    request,
                    parent_job_id=parent.job_id,
                    parent_checkpoint_id=None,
                    parent_policy=None,
                    spec=TrainingSpec.model_validate(request.spec.written().with_settings({"seed": seed})),
                )
            if not self._search.elsewhere:
                row.job_id = self._submit(request, number)
        except InvalidError as error:
            from optuna.trial import TrialState as Told

            self._study.tell(number, state=Told.FAIL, skip_if_finished=True)
            row.state, row.error = TrialState.FAILED, str(error)
            row.finished_at = func.now()
        self._rows[number] = row
        self._session.add(row)

    def _submit(self, request: JobRequest, number: int) -> str:
        """Queue the job of a trial; return its id."""
        request = replace(request, name=f"{self._row.name[:180]}-{number}")
        job, _ = add_job(self._session, request, self._row.owner, see_all=True, group_id=self._row.id)
        return job.id

    def _sampler(self) -> optuna.samplers.BaseSampler:
        import optuna

        # A new seed for each choice: every pass makes a new sampler.
        words = f"{self._search.seed}:{len(self._rows)}"
        seed = int.from_bytes(hashlib.sha256(words.encode()).digest()[:4], "big")
        if self._search.sampler in ("random", "population"):
            return optuna.samplers.RandomSampler(seed=seed)
        return optuna.samplers.TPESampler(seed=seed, n_startup_trials=self._search.startup_trials, constant_liar=True)


def _suggest(trial: optuna.trial.Trial, name: str, item: Parameter) -> Any:
    """Return the value of a setting in a trial, chosen now if it has none yet."""
    value = trial._suggest(name, _distribution(item))
    return json.loads(value) if isinstance(item, Choices) else value


def _distribution(item: Parameter) -> optuna.distributions.BaseDistribution:
    from optuna import distributions

    if isinstance(item, Choices):
        return distributions.CategoricalDistribution([_stored(item, choice) for choice in item.choices])
    if isinstance(item, IntRange):
        return distributions.IntDistribution(item.low, item.high, step=item.step or 1, log=item.log)
    return distributions.FloatDistribution(item.low, item.high, step=item.step, log=item.log)


def _stored(item: Parameter, value: Any) -> Any:
    """Return a value as Optuna stores it: scalars, where ours may be lists."""
    return json.dumps(value) if isinstance(item, Choices) else value


def _pruner(pruning: Pruning) -> optuna.pruners.BasePruner:
    import optuna

    first = pruning.warmup_intervals + 1
    if pruning.name == "median":
        return optuna.pruners.MedianPruner(pruning.startup_trials, first)
    if pruning.name == "asha":
        return optuna.pruners.SuccessiveHalvingPruner(first, pruning.reduction_factor)
    return optuna.pruners.NopPruner()
