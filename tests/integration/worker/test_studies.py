"""Studies with real trainings, and the conductor against a real Postgres."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import warnings
from collections.abc import Iterator
from typing import Any

import httpx
import psycopg
import pytest
from naojobs import leases, outcomes, requests, studies
from naojobs.errors import ConflictError, InvalidError, QuotaError
from naojobs.models import Evaluation, Job, Study, StudyState, Trial, TrialState
from naojobs.quotas import Quota
from naojobs.roles import Role
from naojobs.states import ENDED, WorkState
from naojobs.studies import StudyRequest
from naojobs.submission import JobRequest
from naojobs.tokens import Scope, create_token
from naospec import EvaluationSpec, TrainingSpec
from naospec.flat import nest
from naospec.search import SearchSpec
from naosprint_worker.studies import Conductor
from sqlalchemy import select, text

from tests.integration.attempts import claim_work
from tests.integration.conftest import as_role
from tests.integration.writes import append_metrics, record_checkpoint, refusing
from tests.ports import reserved_port

from .conftest import ROLLOUT, TINY, Broker, Service

SPACE = {
    "learning_rate": {"type": "float", "low": 1e-4, "high": 1e-2, "log": True},
    "n_epochs": {"type": "int", "low": 1, "high": 3},
    "hidden_sizes": {"type": "choice", "choices": [[4], [8]]},
}


def start(service: Service, *, evaluate: bool = False, **search: Any) -> Study:
    spec = TrainingSpec.model_validate(nest({**TINY, "total_steps": ROLLOUT * 20}))
    evaluation = EvaluationSpec(task="sprint2", episodes=2, n_envs=2, bootstrap_resamples=100) if evaluate else None
    request = StudyRequest(
        JobRequest(spec, evaluation), SearchSpec.model_validate({"space": SPACE, "trials": 4, **search})
    )
    return studies.submit_study(service.sessions, request, owner="tester")[0]


def study_of(service: Service, study_id: str) -> tuple[Study, list[Trial]]:
    with service.sessions() as session:
        return session.get_one(Study, study_id), studies.trials_of(session, study_id)


def told(service: Service, study_id: str) -> list[Any]:
    """Return the trials as Optuna has them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import optuna

        conductor = Conductor(service.sessions, service.settings.sqlalchemy_url)
        return list(optuna.load_study(study_name=study_id, storage=conductor._optuna()).get_trials())


def test_a_study_that_cannot_be_advanced_fails_and_keeps_no_other_from_advancing(
    service: Service, conductor: Conductor
) -> None:
    """In whichever order they are advanced. When its plug-in is back, the failed study can be extended."""
    broken, whole = start(service), start(service)
    with service.sessions.begin() as session:
        row = session.get_one(Study, broken.id)
        spec = row.job["spec"]
        row.job = {**row.job, "spec": {**spec, "task": {"name": "gone"}}}
    assert conductor.advance_all()
    assert len(study_of(service, whole.id)[1]) == 2
    ended, trials = study_of(service, broken.id)
    assert (ended.state, trials) == (StudyState.FAILED, [])
    assert (
        ended.error is not None and ended.error.startswith("it does not fit this version: ") and "gone" in ended.error
    )

    with service.sessions.begin() as session:
        row = session.get_one(Study, broken.id)
        row.job = {**row.job, "spec": spec}
    studies.extend_study(service.sessions, broken.id, 5)
    assert conductor.advance_all()
    assert len(study_of(service, broken.id)[1]) == 2


def test_a_pass_takes_no_id_of_optuna(service: Service, conductor: Conductor) -> None:
    """Its sequence has 32 bits, and a study that runs for weeks is advanced every second."""

    def last() -> object:
        with service.sessions() as session:
            return session.scalar(text("SELECT last_value FROM optuna.studies_study_id_seq"))

    study = start(service)
    assert conductor.advance(study.id)
    first = last()
    assert not any(conductor.advance(study.id) for _ in range(3))
    assert last() == first


def test_an_error_of_the_database_for_one_study_keeps_no_other_from_advancing(
    service: Service, conductor: Conductor, caplog: pytest.LogCaptureFixture
) -> None:
    running = [start(service, parallel=1) for _ in range(3)]
    refused = running[1].id
    with refusing(service.sessions, "trials", f"NEW.study_id = '{refused}'"):
        assert conductor.advance_all()
    assert f"study {refused} waits for the database" in caplog.text
    for study in running:
        found, trials = study_of(service, study.id)
        assert (found.state, len(trials)) == (StudyState.RUNNING, int(study.id != refused))
    assert conductor.advance_all()
    assert len(study_of(service, refused)[1]) == 1


def test_an_error_of_optuna_s_storage_ends_no_study(
    service: Service, conductor: Conductor, caplog: pytest.LogCaptureFixture
) -> None:
    """Its connections, which are new ones, reach a server that is read-only after a failover."""
    study = start(service, parallel=2)
    assert conductor.advance_all()
    ended, running = (str(trial.job_id) for trial in study_of(service, study.id)[1])
    requests.request_cancel(service.sessions, Job, ended)
    change = f"ALTER DATABASE {service.engine.url.database} {{}} default_transaction_read_only {{}}"
    with psycopg.connect(service.postgres.url("postgres"), autocommit=True) as connection:
        connection.execute(change.format("SET", "= on").encode())
        try:
            assert not conductor.advance_all()
            assert "waits for the database: InternalError: " in caplog.text  # ours would be an outage
        finally:
            connection.execute(change.format("RESET", "").encode())
    study, trials = study_of(service, study.id)
    assert (study.state, [trial.state for trial in trials]) == (StudyState.RUNNING, [TrialState.RUNNING] * 2)
    assert service.job(running).state is WorkState.QUEUED
    assert conductor.advance_all()
    states = [trial.state for trial in study_of(service, study.id)[1]]
    assert states == [TrialState.FAILED, TrialState.RUNNING, TrialState.RUNNING]


@pytest.fixture
def conductor(service: Service) -> Conductor:
    return Conductor(service.sessions, service.settings.sqlalchemy_url)


def take(service: Service, job_id: str) -> leases.Lease:
    claim = claim_work(service.sessions, Job, job_id, "worker")
    assert claim is not None
    outcomes.begin(service.sessions, claim.lease, step=0)
    outcomes.transition(service.sessions, claim.lease, WorkState.RUNNING)
    return claim.lease


@pytest.mark.timeout(400)
def test_a_study_survives_the_death_of_worker_broker_and_api(
    service: Service, broker: Broker, request: pytest.FixtureRequest
) -> None:
    """Each trial has one job, ends once, and counts once."""
    port = reserved_port()
    apis: list[subprocess.Popen[bytes]] = []
    request.addfinalizer(lambda: [api.kill() or api.wait() for api in apis])  # type: ignore[func-returns-value]
    _, secret = create_token(service.sessions, name="test", owner="alice", scopes=[Scope.SUBMIT])
    client = httpx.Client(
        base_url=f"http://127.0.0.1:{port}", headers={"Authorization": f"Bearer {secret}"}, trust_env=False, timeout=60
    )

    def start_api() -> subprocess.Popen[bytes]:
        database = as_role(service.environment["NAOSPRINT_DATABASE_URL"], Role.API)
        environment = {**service.environment, "NAOSPRINT_DATABASE_URL": database, "NAOSPRINT_API_PORT": str(port)}
        with (service.folder / "api.log").open("ab") as log:
            api = subprocess.Popen([sys.executable, "-m", "naosprint_api"], env=environment, stdout=log, stderr=log)
        apis.append(api)

        def ready() -> bool:
            try:
                return client.get("/readyz").status_code == 200
            except httpx.TransportError:
                return False

        service.until(ready, what="for the API")
        return api

    api = start_api()
    worker = service.start_worker(NAOSPRINT_WORKER_CONCURRENCY="2")
    body = {
        "job": {
            "spec": nest({**TINY, "total_steps": ROLLOUT * 60, "checkpoint_interval_steps": ROLLOUT * 10}),
            "evaluation": {"task": "sprint2", "episodes": 2, "n_envs": 2, "bootstrap_resamples": 100},
        },
        "search": {"space": SPACE, "trials": 3, "parallel": 2, "objectives": [{"metric": "distance_m"}]},
        "name": "lost",
    }
    answer = client.post("/studies", json=body, headers={"Idempotency-Key": "one"})
    assert answer.status_code == 201, answer.text
    study_id = answer.json()["id"]

    service.until(worker.trainings, what="for a trial to train")
    broker.stop()
    os.killpg(worker.pid, signal.SIGKILL)
    api.kill()
    api.wait()
    broker.start()
    start_api()
    assert client.post("/studies", json=body, headers={"Idempotency-Key": "one"}).json()["id"] == study_id
    worker = service.start_worker(NAOSPRINT_WORKER_CONCURRENCY="2")
    service.until(lambda: len(study_of(service, study_id)[1]) > 2, what="for another trial")
    os.killpg(worker.pid, signal.SIGKILL)
    service.start_worker(NAOSPRINT_WORKER_CONCURRENCY="2")
    service.until(
        lambda: study_of(service, study_id)[0].state is StudyState.FINISHED, timeout_s=300, what="for the study"
    )

    shown = client.get(f"/studies/{study_id}").json()
    client.close()
    assert [trial["number"] for trial in shown["trials"]] == [0, 1, 2]
    assert [trial["state"] for trial in shown["trials"]] == ["complete"] * 3
    assert len({trial["job_id"] for trial in shown["trials"]}) == 3
    optuna_trials = told(service, study_id)
    assert [trial.values for trial in optuna_trials] == [trial["values"] for trial in shown["trials"]]
    best = max(shown["trials"], key=lambda trial: trial["values"][0])
    assert shown["best"] == [best["number"]]
    with service.sessions() as session:
        jobs = list(session.scalars(select(Job)))
    assert {job.id for job in jobs} == {trial["job_id"] for trial in shown["trials"]}
    for trial in shown["trials"]:
        (job,) = [job for job in jobs if job.id == trial["job_id"]]
        assert job.group_id == study_id
        assert job.spec["algorithm"]["learning_rate"] == trial["params"]["learning_rate"]
        assert job.spec["algorithm"]["hidden_sizes"] == trial["params"]["hidden_sizes"]


def test_what_an_interrupted_pass_asked_for_gets_its_job(service: Service, conductor: Conductor) -> None:
    study = start(service, parallel=2)
    conductor.advance(study.id)
    import optuna

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        asked = optuna.load_study(study_name=study.id, storage=conductor._optuna()).ask()
        asked.suggest_int("n_epochs", 1, 3)  # and here it was killed
    rows = study_of(service, study.id)[1]
    requests.request_cancel(service.sessions, Job, str(rows[0].job_id))
    assert conductor.advance(study.id)
    rows = study_of(service, study.id)[1]
    assert [row.number for row in rows] == [0, 1, 2]
    assert rows[2].params["n_epochs"] == asked.params["n_epochs"]
    assert rows[2].params.keys() == SPACE.keys()
    assert [row.state for row in rows] == [TrialState.FAILED, TrialState.RUNNING, TrialState.RUNNING]
    assert not conductor.advance(study.id)
    assert len(study_of(service, study.id)[1]) == 3


def test_a_report_whose_row_was_not_written_counts_once(service: Service, conductor: Conductor) -> None:
    study = start(service, parallel=1, objectives=[{"metric": "reward"}])
    conductor.advance(study.id)
    job_id = str(study_of(service, study.id)[1][0].job_id)
    lease = take(service, job_id)
    append_metrics(service.sessions, lease, [{"step": ROLLOUT * 20, "reward": 3.0}])
    outcomes.transition(service.sessions, lease, WorkState.SUCCEEDED)
    import optuna

    optuna.load_study(study_name=study.id, storage=conductor._optuna()).tell(0, 3.0)
    conductor.advance(study.id)
    rows = study_of(service, study.id)[1]
    assert (rows[0].state, rows[0].values) == (TrialState.COMPLETE, [3.0])
    assert [trial.number for trial in told(service, study.id)] == [0, 1]


def test_a_trial_that_falls_behind_is_pruned_and_says_why(service: Service, conductor: Conductor) -> None:
    pruning = {"name": "median", "metric": "reward", "startup_trials": 2, "warmup_intervals": 1}
    study = start(
        service, parallel=3, trials=3, pruning={**pruning, "interval_steps": ROLLOUT}, objectives=[{"metric": "reward"}]
    )
    conductor.advance(study.id)
    held = [take(service, str(row.job_id)) for row in study_of(service, study.id)[1]]
    for lease in held[:2]:
        rows = [{"step": ROLLOUT * n, "reward": float(n)} for n in range(1, 21)]
        append_metrics(service.sessions, lease, rows)
        outcomes.transition(service.sessions, lease, WorkState.SUCCEEDED)
    append_metrics(service.sessions, held[2], [{"step": ROLLOUT, "reward": -5.0}])
    conductor.advance(study.id)
    assert not leases.read_requests(service.sessions, held[2]).cancel, "within its first interval"
    append_metrics(service.sessions, held[2], [{"step": ROLLOUT * 2, "reward": -5.0}])
    conductor.advance(study.id)
    assert leases.read_requests(service.sessions, held[2]).cancel
    outcomes.transition(service.sessions, held[2], WorkState.CANCELLED, message="cancelled as requested")
    conductor.advance(study.id)
    study, rows = study_of(service, study.id)
    assert [row.state for row in rows] == [TrialState.COMPLETE, TrialState.COMPLETE, TrialState.PRUNED]
    reason = "reward was -5 up to step 32, behind other trials (median pruning)"
    assert rows[2].error == reason
    assert service.job(str(rows[2].job_id)).error == f"pruned: {reason}"
    assert service.events(str(rows[2].job_id))[-1].message == f"pruned: {reason}"
    assert study.state is StudyState.FINISHED


def test_halving_keeps_the_best_at_each_rung(service: Service, conductor: Conductor) -> None:
    pruning = {"name": "asha", "interval_steps": ROLLOUT, "warmup_intervals": 1, "reduction_factor": 2}
    study = start(service, parallel=4, trials=4, pruning=pruning, objectives=[{"metric": "fall_rate"}])
    conductor.advance(study.id)
    held = [take(service, str(row.job_id)) for row in study_of(service, study.id)[1]]
    for falls, lease in zip((0.1, 0.9, 0.8, 0.2), held, strict=True):
        rows = [{"step": ROLLOUT * n, "fall_rate": falls} for n in (1, 2)]
        append_metrics(service.sessions, lease, rows)
        conductor.advance(study.id)
    pruned = [leases.read_requests(service.sessions, lease).cancel for lease in held]
    assert pruned == [False, True, True, False]


def test_several_objectives_have_a_pareto_front(service: Service, conductor: Conductor) -> None:
    objectives = [{"metric": "speed_mps"}, {"metric": "fall_rate"}]
    study = start(service, parallel=4, trials=4, objectives=objectives)
    conductor.advance(study.id)
    points = [(3.0, 0.5), (2.0, 0.1), (2.5, 0.6), (3.0, 0.4)]
    for (speed, falls), row in zip(points, study_of(service, study.id)[1], strict=True):
        lease = take(service, str(row.job_id))
        append_metrics(service.sessions, lease, [{"step": 320, "speed_mps": speed, "fall_rate": falls}])
        outcomes.transition(service.sessions, lease, WorkState.SUCCEEDED)
    conductor.advance(study.id)
    study, rows = study_of(service, study.id)
    search = SearchSpec.model_validate(study.spec)
    assert [objective.direction for objective in search.objectives] == ["maximize", "minimize"]
    assert studies.pareto_front(search, rows) == [1, 3]


def test_a_population_continues_from_the_policies_of_its_best(service: Service) -> None:
    """The worker is killed between two generations: no trial is lost, none started twice."""
    space = {name: SPACE[name] for name in ("learning_rate", "n_epochs")}
    how = {"sampler": "population", "population": 4, "trials": 12, "parallel": 2}
    study = start(service, evaluate=True, space=space, objectives=[{"metric": "distance_m"}], **how)
    worker = service.start_worker(NAOSPRINT_WORKER_CONCURRENCY="2")

    def trials() -> list[Trial]:
        return study_of(service, study.id)[1]

    service.until(lambda: len(trials()) > 5, what="for the second generation")
    worker.process.kill()
    service.start_worker(NAOSPRINT_WORKER_CONCURRENCY="2")
    service.until(lambda: study_of(service, study.id)[0].state is StudyState.FINISHED, what="for the end")
    rows = {trial.number: trial for trial in trials()}
    assert sorted(rows) == list(range(12))
    assert {trial.state: trial.error for trial in rows.values()} == {TrialState.COMPLETE: None}
    with service.sessions() as session:
        evaluations = {item.job_id: item.summary or {} for item in session.scalars(select(Evaluation))}
    for trial in rows.values():
        results = {result["name"]: result["value"] for result in evaluations[trial.job_id or ""]["results"]}
        assert trial.values == [results["distance_m"]]
    by_job = {trial.job_id: trial.number for trial in rows.values()}
    for first in (4, 8):
        before = sorted(range(first - 4, first), key=lambda number: -(rows[number].values or [0.0])[0])
        for number in range(first, first + 4):
            job = service.job(rows[number].job_id or "")
            parent = by_job[job.parent_job_id]
            assert parent == (before[0] if number - 4 == before[-1] else number - 4)
            assert (rows[number].params == rows[parent].params) is (parent == number - 4)
            assert job.spec["seed"] == first // 4


def test_a_study_whose_trials_all_fail_fails(service: Service, conductor: Conductor) -> None:
    study = start(service, parallel=2, trials=20)
    for _ in range(studies.MAX_FAILURES_IN_A_ROW):
        conductor.advance(study.id)
        for row in study_of(service, study.id)[1]:
            if row.state is TrialState.RUNNING and service.job(str(row.job_id)).state not in ENDED:
                requests.request_cancel(service.sessions, Job, str(row.job_id))
                break
    conductor.advance(study.id)
    study, rows = study_of(service, study.id)
    assert study.state is StudyState.FAILED
    assert "5 trials in a row failed" in str(study.error)
    assert all(service.job(str(row.job_id)).state is WorkState.CANCELLED for row in rows)


def test_cancel_and_delete(service: Service, conductor: Conductor) -> None:
    study = start(service, parallel=2)
    conductor.advance(study.id)
    rows = study_of(service, study.id)[1]
    requests.request_cancel(service.sessions, Job, str(rows[0].job_id))
    requests.delete(service.sessions, str(rows[0].job_id))
    conductor.advance(study.id)
    assert study_of(service, study.id)[1][0].error == "its job was deleted"
    with pytest.raises(ConflictError):
        studies.delete_study(service.sessions, study.id)
    studies.cancel_study(service.sessions, study.id)
    assert service.job(str(rows[1].job_id)).state is WorkState.CANCELLED
    assert not conductor.advance(study.id)
    studies.delete_study(service.sessions, study.id)
    conductor.forget_deleted()
    assert conductor._optuna().get_all_studies() == []


def test_what_optuna_cannot_delete_of_one_study_keeps_that_of_no_other(service: Service, conductor: Conductor) -> None:
    deleted = [start(service).id for _ in range(3)]
    for study_id in deleted:
        conductor.advance(study_id)
        studies.cancel_study(service.sessions, study_id)
        studies.delete_study(service.sessions, study_id)
    with refusing(service.sessions, "optuna.studies", f"OLD.study_name = '{deleted[0]}'", "DELETE"):
        conductor.forget_deleted()
    assert [study.study_name for study in conductor._optuna().get_all_studies()] == deleted[:1]
    conductor.forget_deleted()
    assert conductor._optuna().get_all_studies() == []


def test_what_optuna_holds_of_a_study_that_begins_meanwhile_stays(
    service: Service, conductor: Conductor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another worker begins one just before or just after Optuna's studies are listed."""
    deleted = start(service)
    conductor.advance(deleted.id)
    studies.cancel_study(service.sessions, deleted.id)
    studies.delete_study(service.sessions, deleted.id)
    other = Conductor(service.sessions, service.settings.sqlalchemy_url)
    storage = conductor._optuna()
    listed = storage.get_all_studies
    begun: list[str] = []

    def begin() -> None:
        begun.append(start(service).id)
        assert other.advance(begun[-1])

    def listed_meanwhile() -> Any:
        begin()
        found = listed()
        begin()
        return found

    monkeypatch.setattr(storage, "get_all_studies", listed_meanwhile)
    conductor.forget_deleted()
    assert [study.study_name for study in listed()] == begun


def test_two_workers_may_delete_what_optuna_holds_at_once(
    service: Service, conductor: Conductor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other worker deletes the first study after this one has listed both."""
    for study in [start(service) for _ in range(2)]:
        conductor.advance(study.id)
        studies.cancel_study(service.sessions, study.id)
        studies.delete_study(service.sessions, study.id)
    storage, other = conductor._optuna(), Conductor(service.sessions, service.settings.sqlalchemy_url)._optuna()
    listed = storage.get_all_studies

    def listed_before() -> Any:
        found = listed()
        other.delete_study(found[0]._study_id)
        return found

    monkeypatch.setattr(storage, "get_all_studies", listed_before)
    conductor.forget_deleted()
    assert listed() == []


@pytest.mark.parametrize(
    ("search", "field"),
    [
        ({"space": {"wings": {"type": "int", "low": 1, "high": 2}}}, "search.space.wings"),
        ({"space": {"gamma": {"type": "float", "low": 0.9, "high": 1.5}}}, "search.space.gamma"),
        ({"objectives": [{"metric": "beauty"}]}, "search.objectives.0"),
        ({"sampler": "population", "population": 4, "trials": 8}, "search.space.hidden_sizes"),
        ({"objectives": [{"metric": "episode_length"}]}, "search.objectives.0.direction"),
        ({"pruning": {"name": "median", "metric": "beauty"}}, "search.pruning.metric"),
    ],
)
def test_a_study_that_cannot_work_is_refused(shared: Service, search: dict[str, Any], field: str) -> None:
    with pytest.raises(InvalidError) as caught:
        start(shared, **search)
    assert caught.value.field == field


@pytest.fixture(autouse=True)
def _optuna_is_quiet() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="optuna")
        yield


def test_a_study_continues_without_the_tables_of_optuna(service: Service, conductor: Conductor) -> None:
    """A backup contains none of them."""
    pruning = {"name": "median", "metric": "reward", "interval_steps": ROLLOUT}
    study = start(service, parallel=3, pruning=pruning, objectives=[{"metric": "reward"}])
    conductor.advance(study.id)
    held = [take(service, str(row.job_id)) for row in study_of(service, study.id)[1]]
    for lease, reward in zip(held, (3.0, 1.0, 2.0), strict=True):
        append_metrics(service.sessions, lease, [{"step": ROLLOUT * n, "reward": reward * n} for n in range(1, 21)])
    for lease, state in zip(held[:2], (WorkState.SUCCEEDED, WorkState.FAILED), strict=True):
        outcomes.transition(service.sessions, lease, state)
    conductor.advance(study.id)
    before = told(service, study.id)
    rows = study_of(service, study.id)[1]
    with service.sessions.begin() as session:
        session.execute(text("DROP SCHEMA optuna CASCADE"))
        session.execute(text("CREATE SCHEMA optuna"))
    later = Conductor(service.sessions, service.settings.sqlalchemy_url)
    later.advance(study.id)
    after = told(service, study.id)

    def seen(trials: list[Any]) -> list[tuple[object, ...]]:
        parts = ("number", "state", "values", "params", "distributions", "intermediate_values")
        return [tuple(getattr(trial, part) for part in parts) for trial in trials]

    assert seen(after)[: len(before)] == seen(before)
    assert [trial.number for trial in study_of(service, study.id)[1]] == [row.number for row in rows]
    outcomes.transition(service.sessions, held[2], WorkState.SUCCEEDED)
    later.advance(study.id)
    settled = {trial.number: trial for trial in told(service, study.id)}
    assert settled[2].values == [pytest.approx(40.0)]


def test_a_finished_study_that_is_extended_learns_from_its_first_trials(service: Service, conductor: Conductor) -> None:
    study = start(service, trials=2, parallel=2, objectives=[{"metric": "reward"}])

    def finish(expected: int) -> None:
        conductor.advance(study.id)
        rows = [row for row in study_of(service, study.id)[1] if row.state is TrialState.RUNNING]
        assert len(rows) == expected
        for row in rows:
            lease = take(service, str(row.job_id))
            append_metrics(service.sessions, lease, [{"step": ROLLOUT, "reward": float(row.number)}])
            outcomes.transition(service.sessions, lease, WorkState.SUCCEEDED)
        conductor.advance(study.id)

    finish(2)
    assert study_of(service, study.id)[0].state is StudyState.FINISHED
    with pytest.raises(InvalidError, match="has started 2 trials"):
        studies.extend_study(service.sessions, study.id, 2)
    extended = studies.extend_study(service.sessions, study.id, 4)
    assert (extended.state, extended.finished_at) == (StudyState.RUNNING, None)
    finish(2)
    study, rows = study_of(service, study.id)
    assert study.state is StudyState.FINISHED
    assert [trial.values for trial in rows] == [[0.0], [1.0], [2.0], [3.0]]
    assert len(told(service, study.id)) == 4


@pytest.mark.parametrize("quota", [Quota.JOBS, Quota.BYTES, Quota.ROWS])
def test_a_study_is_extended_only_where_its_owner_has_room(service: Service, quota: Quota) -> None:
    study = start(service)
    studies.cancel_study(service.sessions, study.id)
    with pytest.raises(QuotaError, match=quota.value.what):
        studies.extend_study(service.sessions, study.id, 9, limits={quota: 0})
    with service.sessions() as session:
        assert session.get_one(Study, study.id).state is StudyState.CANCELLED


def test_a_failed_study_that_is_extended_gets_a_new_chance(service: Service, conductor: Conductor) -> None:
    study = start(service, trials=studies.MAX_FAILURES_IN_A_ROW, parallel=studies.MAX_FAILURES_IN_A_ROW)
    for _ in range(3):
        conductor.advance(study.id)
        for row in study_of(service, study.id)[1]:
            if row.job_id and service.job(row.job_id).state not in ENDED:
                requests.request_cancel(service.sessions, Job, row.job_id)
    ended = study_of(service, study.id)[0].state
    assert ended in (StudyState.FAILED, StudyState.FINISHED)
    studies.extend_study(service.sessions, study.id, 7)
    assert conductor.advance(study.id)
    assert study_of(service, study.id)[0].state is StudyState.RUNNING


def test_trials_start_from_a_policy(service: Service, conductor: Conductor) -> None:
    space = {name: SPACE[name] for name in ("learning_rate", "n_epochs")}
    spec = TrainingSpec.model_validate(nest({**TINY, "total_steps": ROLLOUT * 20}))
    search = SearchSpec.model_validate({"space": space, "trials": 2})
    request = StudyRequest(JobRequest(spec, parent_policy="sprint"), search)
    with pytest.raises(InvalidError, match="hidden_sizes") as caught:
        studies.submit_study(service.sessions, request, owner="tester")
    assert caught.value.field == "job.spec.algorithm.hidden_sizes"
    parent = service.submit(announce=False, evaluate=False, total_steps=ROLLOUT)
    with pytest.raises(InvalidError, match="no trained checkpoint yet"):
        studies.submit_study(
            service.sessions, StudyRequest(JobRequest(spec, parent_job_id=parent), search), owner="tester"
        )
    manifest = {"files": [{"name": "policy.npz", "size": 1, "sha256": "0" * 64}]}
    checkpoint = record_checkpoint(
        service.sessions, take(service, parent), step=ROLLOUT, key="jobs/parent/1", manifest=manifest
    )
    narrower = {"hidden_sizes": {"type": "choice", "choices": [[4], [8], [2]]}}
    with pytest.raises(InvalidError, match="hidden_sizes"):
        studies.submit_study(
            service.sessions,
            StudyRequest(JobRequest(spec, parent_job_id=parent), SearchSpec.model_validate({"space": narrower})),
            owner="tester",
        )
    study, _ = studies.submit_study(
        service.sessions, StudyRequest(JobRequest(spec, parent_job_id=parent), search), owner="tester"
    )
    conductor.advance(study.id)
    for row in study_of(service, study.id)[1]:
        job = service.job(str(row.job_id))
        assert (job.parent_job_id, job.parent_checkpoint_id, job.needs_policy) == (parent, checkpoint, True)


def test_trials_run_elsewhere(service: Service, conductor: Conductor) -> None:
    """The best of what is reported counts, and Optuna learns from it."""
    objectives = [{"metric": "score", "direction": "maximize"}]
    study = start(service, trials=3, parallel=2, objectives=objectives, elsewhere=True)
    with pytest.raises(ConflictError, match="no trial waits"):
        studies.ask(service.sessions, study.id)
    conductor.advance(study.id)
    first, job = studies.ask(service.sessions, study.id)
    assert job.spec.algorithm.n_epochs == first.params["n_epochs"]  # type: ignore[attr-defined]
    second, _ = studies.ask(service.sessions, study.id)
    with pytest.raises(ConflictError, match="no trial waits"):
        studies.ask(service.sessions, study.id)
    with pytest.raises(InvalidError, match="expected 1 values"):
        studies.tell(service.sessions, study.id, first.number, values=[1.0, 2.0])
    for _ in range(2):  # a repeated report changes nothing
        studies.tell(service.sessions, study.id, first.number, values=[1.5])
    with pytest.raises(ConflictError, match="reported already"):
        studies.tell(service.sessions, study.id, first.number, values=[2.5])
    studies.tell(service.sessions, study.id, second.number, error="the machine burned")
    conductor.advance(study.id)
    third, _ = studies.ask(service.sessions, study.id)
    studies.tell(service.sessions, study.id, third.number, values=[0.5])
    conductor.advance(study.id)
    study, rows = study_of(service, study.id)
    assert study.state is StudyState.FINISHED
    assert [(trial.state, trial.values, trial.error) for trial in rows] == [
        (TrialState.COMPLETE, [1.5], None),
        (TrialState.FAILED, None, "the machine burned"),
        (TrialState.COMPLETE, [0.5], None),
    ]
    assert studies.pareto_front(SearchSpec.model_validate(study.spec), rows) == [0]
    assert [trial.values for trial in told(service, study.id)] == [[1.5], None, [0.5]]
    with pytest.raises(ConflictError, match=f"study {study.name} is finished; extend it to continue"):
        studies.tell(service.sessions, study.id, second.number, values=[2.0])


@pytest.mark.parametrize("elsewhere", [False, True])
def test_trials_of_a_cancelled_study_that_is_extended_are_over_for_its_sampler(
    service: Service, conductor: Conductor, elsewhere: bool
) -> None:
    """A sampler avoids what is being tried, and would do so for ever."""
    from optuna.trial import TrialState as Told

    objectives = [{"metric": "reward", "direction": "maximize"}]
    study = start(service, trials=2, parallel=2, elsewhere=elsewhere, objectives=objectives)
    conductor.advance(study.id)
    studies.cancel_study(service.sessions, study.id)
    studies.extend_study(service.sessions, study.id, 4)
    conductor.advance(study.id)
    assert [row.state for row in study_of(service, study.id)[1]] == [TrialState.FAILED] * 2 + [TrialState.RUNNING] * 2
    assert [trial.state for trial in told(service, study.id)] == [Told.FAIL] * 2 + [Told.RUNNING] * 2
