"""Matches over HTTP, played by a real worker on real rcssservermj processes; teams, the league, and who may do what."""

from __future__ import annotations

import base64
import gzip
import hashlib
import io
import json
import os
import tarfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import httpx
import imageio_ffmpeg
import psutil
import pytest
from naojobs import matches
from naojobs.capabilities import Capabilities, match_task, waiting_reasons
from naojobs.errors import LeaseLostError
from naojobs.leases import Lease, MatchClaim
from naojobs.matches import MatchRequest, StoredGame
from naojobs.models import Checkpoint, Match, MatchEvent, Worker
from naojobs.outcomes import lose, succeed, transition
from naojobs.retention import Retention, prune_checkpoints
from naojobs.roles import Role
from naojobs.states import WorkState
from naojobs.store import ArtifactStore, game_key
from naospec import TrainingSpec
from naosprint.matches.log import GameLog
from naosprint.matches.results import match_results
from sqlalchemy import func, select
from sqlalchemy.orm import Session, sessionmaker

from tests.integration.attempts import claim_work
from tests.integration.conftest import as_role
from tests.integration.worker.conftest import FAST, WorkerProcess

Sessions = sessionmaker[Session]

STANDING = """
import socket, sys
host, port, team, number = sys.argv[1:5]
server = socket.create_connection((host, int(port)))
def send(text):
    server.sendall(len(text).to_bytes(4, "big") + text.encode())
send(f"(init T1 {team} {number})")
while True:
    server.recv(int.from_bytes(server.recv(4, socket.MSG_WAITALL), "big"), socket.MSG_WAITALL)
    send("(he1 0 0 20 1 0)")
"""
COMMAND = {"command": ["{python}", "player.py", "{host}", "{port}", "{team}", "{number}"]}


def packed(files: dict[str, str], *others: tarfile.TarInfo) -> bytes:
    """Return a tar archive of files and of other members."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        for name, text in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(text.encode())
            archive.addfile(info, io.BytesIO(text.encode()))
        for info in others:
            archive.addfile(info)
    return buffer.getvalue()


def upload(client: httpx.Client, name: str, data: bytes, **params: str) -> httpx.Response:
    return client.put(
        f"/teams/{name}", content=data, params=params, headers={"Content-Type": "application/octet-stream"}
    )


def until(client: httpx.Client, match_id: str, condition: Callable[[Any], object], timeout_s: float = 400) -> Any:
    """Return a match as soon as a condition holds; fail if it ends before."""
    deadline, pause = time.monotonic() + timeout_s, threading.Event()
    while True:
        match = client.get(f"/matches/{match_id}").raise_for_status().json()
        if condition(match):
            return match
        assert match["state"] not in ("failed", "cancelled", "succeeded"), match
        assert time.monotonic() < deadline, match
        pause.wait(0.3)


@pytest.fixture
def start_worker(
    service_environment: dict[str, str], database_url: str, tmp_path: Path
) -> Iterator[Callable[[], WorkerProcess]]:
    """Start workers of the module's service; they are killed after the test."""
    workers: list[WorkerProcess] = []
    environment = {
        **os.environ,
        **FAST,
        **service_environment,
        "NAOSPRINT_DATABASE_URL": as_role(database_url, Role.WORKER),
        "NAOSPRINT_WORKER_DIR": str(tmp_path / "work"),
    }

    def start() -> WorkerProcess:
        workers.append(WorkerProcess(environment, tmp_path / f"worker-{len(workers)}.log"))
        return workers[-1]

    yield start
    for worker in workers:
        children = psutil.Process(worker.pid).children(recursive=True) if worker.process.poll() is None else []
        worker.process.kill()
        worker.process.wait()
        for child in children:
            child.kill()


@pytest.mark.timeout(900)  # two games of a few seconds, on servers that share a busy machine
def test_a_match_survives_its_worker_and_keeps_the_games_that_are_over(
    client: httpx.Client, admin: httpx.Client, start_worker: Callable[[], WorkerProcess], tmp_path: Path
) -> None:
    files = {"team.json": json.dumps(COMMAND), "player.py": STANDING}
    assert upload(admin, "standing", packed(files), owner="alice").status_code == 201
    teams = ["example:walk=t1-run-robust", "standing"]
    body = {"teams": teams, "games": 2, "players": 1, "half_s": 2.0, "film": "all"}
    made = client.post("/matches", json=body).raise_for_status().json()
    worker = start_worker()
    first = until(client, made["id"], lambda match: match["finished"])
    (game,) = first["finished"]
    until(client, made["id"], lambda match: match["live"] and match["live"]["game"] == 2)
    playing = [each["matches"] for each in client.get("/workers").raise_for_status().json()["items"]]
    assert playing == [[made["id"]]]
    worker.process.kill()
    worker.process.wait()
    start_worker()
    ended = until(client, made["id"], lambda match: match["state"] == "succeeded")
    assert ended["attempt"] >= 2
    assert ended["finished"][0] == game
    assert ended["live"] is None
    assert [each["number"] for each in ended["finished"]] == [1, 2]
    logs = []
    for each in ended["finished"]:
        answer = client.get(each["log"]["url"]).raise_for_status()
        assert hashlib.sha256(answer.content).hexdigest() == each["log"]["sha256"]
        (tmp_path / each["log"]["name"]).write_bytes(answer.content)
        logs.append(GameLog.load(tmp_path / each["log"]["name"]))
        assert logs[-1].goals == tuple(each["goals"])
        film = client.get(each["film"]["url"]).raise_for_status()
        assert hashlib.sha256(film.content).hexdigest() == each["film"]["sha256"]
        (tmp_path / each["film"]["name"]).write_bytes(film.content)
        pictures, seconds = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / each["film"]["name"]))
        assert (pictures, seconds) == (len(logs[-1].mode), pytest.approx(0.04 * len(logs[-1].mode), abs=0.1))
    history = client.get(f"/matches/{made['id']}/events").raise_for_status().json()["items"]
    assert [each["kind"] for each in history if each["kind"] not in ("info", "warning")][:3] == [
        *("queued", "claimed", "running"),
    ]
    assert history[-1]["kind"] == "succeeded"
    lines = [each["message"] for each in history if each["kind"] == "info"]
    for each in ended["finished"]:
        assert f"game {each['number']} ended {each['goals'][0]}:{each['goals'][1]}" in lines
    last = client.get(f"/matches/{made['id']}/events", params={"after": history[-2]["id"]}).json()
    assert last == {"items": history[-1:], "next_after": history[-1]["id"]}
    # both agents were confined, and the same numbers come from the logs again
    assert {"files", "TCP"} <= set(logs[0].notes["halves"][0]["enforced"])
    assert json.loads(json.dumps(match_results(logs))) == ended["summary"]
    assert ended["table"][0][0] == "goals"
    table = client.get("/league").raise_for_status().json()
    assert {team["name"] for team in table} == {"example:walk=t1-run-robust", "standing"}
    assert sum(team["wins"] + team["draws"] + team["losses"] for team in table) == 4

    again = client.post("/matches", json={**body, "games": 3}).raise_for_status().json()
    running = until(client, again["id"], lambda match: match["live"] and match["live"]["clip"])
    assert {(team, number) for team, number, *_ in running["live"]["players"]} == {(0, 1), (1, 1)}
    (tmp_path / "clip.npz").write_bytes(base64.b64decode(running["live"]["clip"]))
    clip = GameLog.load(tmp_path / "clip.npz")
    assert (clip.teams, clip.robots, clip.joints_rad.shape[1:]) == (tuple(teams), [(0, 1), (1, 1)], (2, 23))
    client.post(f"/matches/{again['id']}/cancel").raise_for_status()
    assert until(client, again["id"], lambda match: match["state"] == "cancelled")["live"] is None
    assert client.delete(f"/matches/{again['id']}").status_code == 204
    assert client.get(f"/matches/{again['id']}").status_code == 404

    boxed = packed({"team.json": json.dumps({"image": "boxed:1", "command": ["play", "{port}"]})})
    assert upload(admin, "boxed", boxed, owner="alice").status_code == 201
    waiting = submit(client, "boxed", "standing")
    reason = client.get(f"/matches/{waiting}").json()["waiting_reason"]
    assert reason.endswith("teams with an image a Docker engine and NAOSPRINT_RELAY_IMAGE"), reason
    client.post(f"/matches/{waiting}/cancel").raise_for_status()


def test_a_match_waits_for_a_worker_that_can_play_its_teams(
    client: httpx.Client, admin: httpx.Client, sessions: Sessions
) -> None:
    """A team with an image needs an engine, one without a kernel that confines it, and both of them both."""
    assert upload(admin, "from-a-folder", packed({"team.json": json.dumps(COMMAND)}), owner="alice").status_code == 201
    image = {"image": "team:1", "command": ["play", "{port}"]}
    assert upload(admin, "from-an-image", packed({"team.json": json.dumps(image)}), owner="alice").status_code == 201
    both = (False, True)
    kinds = {(one, two): match_task(confined=one, contained=two) for one in both for two in both}
    for (confined, contained), task in kinds.items():
        teams = ["from-a-folder" if confined else "example", "from-an-image" if contained else "example"]
        match_id = submit(client, *teams)
        for other in set(kinds.values()) - {task}:
            able = Capabilities({other: 1}, ["t1"], ["match"], [])
            assert claim_work(sessions, Match, match_id, "worker", capabilities=able) is None
        able = Capabilities({task: 1}, ["t1"], ["match"], [])
        assert claim_work(sessions, Match, match_id, "worker", capabilities=able) is not None


CAPABLE = Capabilities({"match": 1, "confined-match": 1}, ["t1"], ["match"], [])


def play(sessions: Sessions, store: ArtifactStore, match_id: str, *goals: tuple[int, int]) -> MatchClaim:
    """Claim a match and record games with these goals."""
    claim = claim_work(sessions, Match, match_id, "worker")
    assert claim is not None
    transition(sessions, claim.lease, WorkState.RUNNING)
    for number, score in enumerate(goals, start=1):
        key = game_key(match_id, number, claim.lease.attempt, "0")
        folder = Path(str(store.local_root)) / "incoming"
        folder.mkdir(exist_ok=True)
        (folder / "game.npz").write_bytes(b"log")
        manifest = store.put_directory(key, folder)
        summary = {"games": number, "wins": 0, "draws": 0, "losses": 0}
        matches.record_game(sessions, claim.lease, StoredGame(number, score, [], key, manifest), summary)
    return claim


def submit(client: httpx.Client, *teams: str, **settings: Any) -> str:
    body = {"teams": list(teams), "games": 2, "players": 1, "half_s": 1.0, **settings}
    made: str = client.post("/matches", json=body).raise_for_status().json()["id"]
    return made


def test_lines_of_a_match_count_as_rows(client: httpx.Client, sessions: Sessions) -> None:
    match_id = submit(client, "example", "example")
    claim = claim_work(sessions, Match, match_id, "worker-1")
    assert claim is not None
    for _ in range(2):
        matches.append_lines(sessions, claim.lease, [("info", "a"), ("warning", "b")])
    with sessions() as session:
        rows = session.scalar(select(func.count()).where(MatchEvent.match_id == match_id))
        assert session.get_one(Match, match_id).row_count == rows == 6


def test_a_claim_is_fenced_and_complete(client: httpx.Client, sessions: Sessions, store: ArtifactStore) -> None:
    match_id = submit(client, "example", "example:walk=t1-run-robust")
    no_matches = Capabilities({"velocity": 1}, ["t1"], ["embedded"], ["ppo"])
    assert claim_work(sessions, Match, match_id, "worker", capabilities=no_matches) is None
    with sessions() as session:
        reasons = waiting_reasons(session, [session.get_one(Match, match_id)], [Worker(**asdict(no_matches))])
    assert "no worker can play it: matches need the package rcsssmj" in reasons[match_id]
    claim = play(sessions, store, match_id, (1, 0))
    assert succeed(sessions, claim.lease) == "1 of 2 games are stored"
    assert lose(sessions, claim.lease, "lost") is WorkState.QUEUED
    with pytest.raises(LeaseLostError):
        matches.record_moment(sessions, claim.lease, {})
    second = claim_work(sessions, Match, match_id, "worker", capabilities=CAPABLE)
    assert second is not None
    assert list(second.games) == [1]
    assert second.lease.attempt == 2


def test_a_repeated_request_makes_one_match(client: httpx.Client) -> None:
    headers = {"Idempotency-Key": "one-match"}
    body = {"teams": ["example", "example"]}
    made = client.post("/matches", json=body, headers=headers)
    assert made.status_code == 201
    again = client.post("/matches", json=body, headers=headers)
    assert (again.status_code, again.json()["id"]) == (200, made.json()["id"])
    other = client.post("/matches", json={**body, "games": 3}, headers=headers)
    assert other.status_code == 409


@pytest.mark.parametrize(
    ("body", "field", "words"),
    [
        ({"teams": ["example", "nobody"]}, "teams.1", "no team 'nobody'; use one of example"),
        ({"teams": ["example:fly=t1-run", "example"]}, "teams.0", "expected one of walk, kick, keep, getup"),
        ({"teams": ["example:walk=t1-kick", "example"]}, "teams.0", "use one for task velocity and robot t1"),
        ({"teams": ["example:walk=gone@3", "example"]}, "teams.0", "there is no policy 'gone'"),
        ({"teams": ["example"]}, "teams", ""),
        ({"teams": ["example", "example"], "players": 8}, "players", "less than or equal to 7"),
        ({"teams": ["example", "example"], "half_s": 301}, "half_s", "less than or equal to 300"),
    ],
)
def test_a_wrong_match_is_refused_with_field_and_fix(
    client: httpx.Client, body: dict[str, Any], field: str, words: str
) -> None:
    answer = client.post("/matches", json=body)
    assert answer.status_code == 422
    (error,) = answer.json()["errors"]
    assert error["field"].startswith(field)
    assert words in error["message"]


def link(name: str) -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.linkname = tarfile.SYMTYPE, "/etc/passwd"
    return info


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"no archive", "expected a tar archive"),
        (gzip.compress(b"no archive", mtime=0), "expected a tar archive"),
        (packed({"player.py": ""}), "no team.json; write one such as"),
        (packed({"team.json": "{"}), "team.json"),
        (packed({"team.json": '{"command": "x"}'}), "command: expected a list of texts"),
        (packed({"team.json": json.dumps({**COMMAND, "reads": ["/"]})}), "put what agents need into the folder"),
        (packed({"team.json": json.dumps({**COMMAND, "image": "a:1"})}), "command: {python} is of this machine"),
        (
            packed({"team.json": json.dumps({"command": ["a"], "image": "-v"})}),
            "image: expected the name of a container",
        ),
        (packed({"team.json": json.dumps(COMMAND)}, link("a")), "pack only files and folders"),
        (packed({"team.json": json.dumps(COMMAND), "../x": ""}), "pack only files and folders"),
        (gzip.compress(bytes(65 << 20)), "at most 64 MiB"),
    ],
)
def test_a_wrong_archive_is_refused(admin: httpx.Client, data: bytes, words: str) -> None:
    answer = upload(admin, "wrong", data)
    assert answer.status_code == 422
    assert words in answer.json()["detail"]
    assert all(team["name"] != "wrong" for team in admin.get("/teams").json()["items"])


def test_teams_and_matches_are_their_owners(
    client: httpx.Client, admin: httpx.Client, make_client: Callable[..., httpx.Client]
) -> None:
    team = packed({"team.json": json.dumps(COMMAND)})
    assert upload(client, "mine", team).status_code == 403
    assert upload(admin, "mine", team, owner="alice").status_code == 201
    assert upload(admin, "mine", team, owner="alice").status_code == 409
    match_id = submit(client, "mine", "example")
    stranger = make_client("bob", "submit")
    assert stranger.get(f"/matches/{match_id}").status_code == 404
    assert stranger.post(f"/matches/{match_id}/cancel").status_code == 404
    assert stranger.get(f"/matches/{match_id}/games/1/log").status_code == 404
    assert stranger.get("/matches").json()["items"] == []
    assert stranger.get("/teams", params={"owner": "alice"}).status_code == 404
    assert stranger.post("/matches", json={"teams": ["mine", "example"]}).status_code == 422
    assert stranger.delete("/teams/mine").status_code == 404
    assert client.delete("/teams/mine").status_code == 409
    assert client.post(f"/matches/{match_id}/cancel").json()["state"] == "cancelled"
    assert client.delete("/teams/mine").status_code == 204
    assert client.post(f"/matches/{match_id}/retry").json()["state"] == "queued"


def test_a_match_whose_team_was_deleted_fails_with_the_reason(
    client: httpx.Client, admin: httpx.Client, sessions: Sessions
) -> None:
    assert upload(admin, "short", packed({"team.json": json.dumps(COMMAND)}), owner="alice").status_code == 201
    match_id = submit(client, "short", "example")
    client.post(f"/matches/{match_id}/cancel").raise_for_status()
    client.delete("/teams/short").raise_for_status()
    client.post(f"/matches/{match_id}/retry").raise_for_status()
    assert claim_work(sessions, Match, match_id, "worker") is None
    match = client.get(f"/matches/{match_id}").json()
    assert (match["state"], match["error"]) == ("failed", "team short was deleted")


def test_what_an_open_match_plays_with_is_neither_pruned_nor_deleted(
    client: httpx.Client, sessions: Sessions, run_job: Callable[..., Lease], save_checkpoint: Callable[..., str]
) -> None:
    """Nor is its policy; a running study's start likewise."""
    lease = run_job(spec=TrainingSpec.model_validate({"task": "velocity", "robot": "t1"}))
    played, started, *_ = [save_checkpoint(lease, step, {"policy.npz": b"%d" % step}) for step in (1, 2, 3, 4)]
    body = {"job_id": lease.job_id, "checkpoint_id": played}
    client.post("/policies/mover/versions", json=body).raise_for_status()
    match_id = submit(client, "example:walk=mover@1", "example")
    job = {"spec": {"task": "velocity", "robot": "t1"}, "parent_job_id": lease.job_id, "parent_checkpoint_id": started}
    search = {"space": {"n_epochs": {"type": "int", "low": 1, "high": 3}}}
    study = client.post("/studies", json={"job": job, "search": search}).raise_for_status().json()
    prune_checkpoints(sessions, lease, Retention(1))
    with sessions() as session:
        kept = select(Checkpoint.step).where(Checkpoint.job_id == lease.job_id).order_by(Checkpoint.step)
        assert session.scalars(kept).all() == [1, 2, 4]
    transition(sessions, lease, WorkState.CANCELLED)
    answer = client.delete("/policies/mover")
    assert (answer.status_code, f"match {match_id}" in answer.json()["detail"]) == (409, True), answer.text
    for user in (f"match {match_id}", f"study {study['id']}"):
        answer = client.delete(f"/jobs/{lease.job_id}")
        assert answer.status_code == 409, answer.text
        kind, work_id = user.split()
        if kind == "study":
            client.delete("/policies/mover").raise_for_status()
            assert f"{user} uses a checkpoint" in client.delete(f"/jobs/{lease.job_id}").json()["detail"]
        path = {"match": "matches", "study": "studies"}[kind]
        client.post(f"/{path}/{work_id}/cancel").raise_for_status()
    assert client.delete(f"/jobs/{lease.job_id}").status_code == 204


def test_an_alias_requires_that_a_version_does_not_lose(
    client: httpx.Client,
    sessions: Sessions,
    run_job: Callable[..., Lease],
    save_checkpoint: Callable[..., str],
) -> None:
    lease = run_job(spec=TrainingSpec.model_validate({"task": "velocity", "robot": "t1"}))
    for step in (1, 2):
        body = {"job_id": lease.job_id, "checkpoint_id": save_checkpoint(lease, step, {"policy.npz": b"%d" % step})}
        client.post("/policies/walker/versions", json=body).raise_for_status()
    path = "/policies/walker/aliases/best"
    wanted = {"requirements": [{"result": "match", "no_worse": True}]}
    assert client.put(f"{path}/requirements", json=wanted).status_code == 200
    assert client.put(path, json={"version": 1}).status_code == 200, "there is none before it"

    def refused() -> str:
        answer = client.put(path, json={"version": 2})
        assert answer.status_code == 409
        return str(answer.json()["detail"])

    def decide(first: str, second: str, *, holds: bool, **settings: Any) -> str:
        match_id = submit(client, first, second, **settings)
        claim = claim_work(sessions, Match, match_id, "worker")
        assert claim is not None
        transition(sessions, claim.lease, WorkState.RUNNING)
        with sessions.begin() as session:
            match = session.get_one(Match, match_id)
            verdict = "does not lose" if holds else "loses"
            match.summary = {"games": 1, "decided": True, "holds": holds, "verdict": verdict}
        assert succeed(sessions, claim.lease) is None
        return match_id

    new, old = "example:walk=walker@2", "example:walk=walker@1"
    assert f"run: naoctl match {new} {old} --games 60 --gate" in refused()
    decide(new, old, holds=True)  # without a test
    decide(old, new, holds=True, gate=True)
    decide(f"{new},kick=t1-kick", "example", holds=True, gate=True)
    assert "none says that" in refused()
    lost = decide(new, old, holds=False, gate=True)
    assert f"{new} loses against {old} ({lost})" in refused()
    decide(new, old, holds=True, gate=True)
    assert client.put(path, json={"version": 2}).status_code == 200

    other = run_job(spec=TrainingSpec.model_validate({"task": "sprint1", "robot": "nao-0"}))
    body = {"job_id": other.job_id, "checkpoint_id": save_checkpoint(other, 1, {"policy.npz": b"1"})}
    client.post("/policies/runner/versions", json=body).raise_for_status()
    answer = client.put("/policies/runner/aliases/best/requirements", json=wanted)
    assert (answer.status_code, "teams have no such skill" in answer.text) == (422, True)
    wanted["requirements"][0]["most"] = 0.1
    assert "give no_worse alone" in client.put(f"{path}/requirements", json=wanted).text


def test_requests_are_equal_only_if_everything_is() -> None:
    request = MatchRequest(("a", "b"), 1, 1, 1.0)
    assert request.digest() == MatchRequest(("a", "b"), 1, 1, 1.0).digest()
    assert request.digest() != MatchRequest(("b", "a"), 1, 1, 1.0).digest()
