"""``naoctl`` and registered policies, against the API."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import naopolicies
import pytest
from naoctl.cli import main
from naoctl.context import Context
from naojobs import records
from naojobs.leases import Lease
from naospec import EvaluationSpec, TrainingSpec
from naosprint.rl.checkpoint import verify_checkpoint
from sqlalchemy.orm import Session, sessionmaker


@pytest.fixture
def naoctl(
    api: Any,
    make_token: Callable[..., str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> Callable[..., str]:
    """Run a command as alice in an empty folder; return what it printed, or its error."""
    monkeypatch.setenv("NAOCTL_URL", api.url)
    monkeypatch.setenv("NAOCTL_TOKEN", make_token("alice", "submit"))
    monkeypatch.setenv("NAOCTL_CONFIG", str(tmp_path / "config.toml"))
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.chdir(tmp_path)

    def run(*words: str, code: int = 0) -> str:
        with pytest.raises(SystemExit) as ended:
            main([*words])
        out, err = capsys.readouterr()
        assert ended.value.code == code, err
        return out if code == 0 else err

    return run


@pytest.fixture
def trained(
    run_job: Callable[..., Lease], save_checkpoint: Callable[..., str], sessions: sessionmaker[Session], store: Any
) -> Lease:
    """A job whose two checkpoints are the bundled policy sprint, the first with an evaluation."""
    source = naopolicies.folder("sprint")
    files = {name: (source / name).read_bytes() for name in ("checkpoint.json", "policy.npz")}
    lease = run_job(spec=TrainingSpec.model_validate(naopolicies.spec("sprint")), name="trained")
    first, _ = (save_checkpoint(lease, step, files) for step in (100, 200))
    card = naopolicies.card("sprint")
    key = f"jobs/{lease.job_id}/evaluations/e-1"
    records.record_evaluation(
        sessions,
        lease,
        checkpoint_id=first,
        spec=EvaluationSpec(),
        summary={name: card[name] for name in ("episodes", "results", "headline", "tables", "evaluation")},
        key=key,
        manifest={"files": [store.put_bytes(f"{key}/evaluation.json", b"{}").model_dump()]},
    )
    return lease


def test_a_policy_from_registration_to_deletion(
    naoctl: Callable[..., str], client: httpx.Client, trained: Lease, tmp_path: Path
) -> None:
    assert naoctl("policies", "register", "fast", trained.job_id, "-c", "100", "-a", "best").startswith(
        "Registered fast@1"
    )
    assert naoctl("policies", "register", "fast", trained.job_id).startswith("Registered fast@2: step 200")
    listed = naoctl("policies", "list")
    assert re.search(r"^fast@2 ", listed, re.MULTILINE)
    assert re.search(r"^sprint ", listed, re.MULTILINE)
    shown = naoctl("policies", "show", "fast@best")
    spec = TrainingSpec.model_validate(naopolicies.spec("sprint"))
    for part in ("fast@1", "best", spec.digest(), "1,000", trained.job_id.split("_")[0]):
        assert part in shown
    compared = naoctl("policies", "compare", "fast@1", "fast@2", "sprint")
    speed = next(line for line in compared.splitlines() if line.startswith("Top speed"))
    assert re.findall(r"\d\.\d\d m/s", speed) == [re.findall(r"\d\.\d\d m/s", speed)[0]] * 2
    assert "best, match" in naoctl("policies", "promote", "fast@2", "best", "match")
    versions = json.loads(naoctl("policies", "versions", "fast", "--json"))
    assert [(card["version"], card["aliases"]) for card in versions] == [(2, ["best", "match"]), (1, [])]
    assert "best" in naoctl("policies", "promote", "fast@2", "match", "--remove")

    words = ("policies", "require", "fast", "match")
    starts = ("--with", "start_noise_deg=8", "--with", "fall_penalty_m=1")
    assert "requires: nothing" in naoctl(*words)
    naoctl(*words, "fall_rate<=0.03", *starts, "--episodes", "1000")
    required = naoctl(*words, "top_speed_mps=now")
    assert "fall_rate <= 0.03 in 1,000 episodes with fall_penalty_m=1 start_noise_deg=8" in required
    assert "top_speed_mps not worse than now in 100 episodes" in required
    assert "match requires" in naoctl("policies", "show", "fast")
    assert "cannot be match" in naoctl("policies", "promote", "fast@2", "match", code=6)
    assert "is no bound" in naoctl(*words, "fall_rate=0.03", code=2)
    shaken = json.loads(naoctl("eval", "fast@2", *starts, "--episodes", "7", "--no-wait", "--json"))["spec"]
    assert (shaken["task"]["start_noise_deg"], shaken["episodes"]) == (8.0, 7)
    assert "start_noise" in naoctl("eval", "fast@2", "--with", "start_noise=1", "--no-wait", code=2)
    assert "requires: nothing" in naoctl(*words, "--clear")

    naoctl("download", "fast@1")
    verify_checkpoint(tmp_path / "fast-1" / "checkpoint")
    assert (tmp_path / "fast-1" / "evaluation" / "evaluation.json").read_bytes() == b"{}"
    assert (tmp_path / "fast-1" / "metrics.jsonl").exists()
    naoctl("download", "sprint")
    verify_checkpoint(tmp_path / "sprint" / "checkpoint")
    assert "one checkpoint" in naoctl("download", "fast@1", "-c", "200", code=2)
    assert "no job 'nothing'" in naoctl("download", "nothing", code=5)

    naoctl("export", "fast@best", "--format", "numpy")
    exported = tmp_path / "fast-2" / "export" / "policy.npz"
    assert exported.is_file()
    evaluation = json.loads(naoctl("eval", "fast@1", "--no-wait", "--json"))
    points = {point["step"]: point["id"] for point in client.get(f"/jobs/{trained.job_id}/checkpoints").json()["items"]}
    assert evaluation["checkpoint_id"] == points[100]
    assert "not evaluate" in naoctl("eval", "sprint", code=2)
    summary = json.loads(naoctl("policies", "evaluate", "fast@best", "--episodes", "1", "--json"))
    assert summary["episodes"] == 1
    job = json.loads(naoctl("submit", "--from-policy", "fast@best", "--recipe", "sprint", "--json"))
    assert (job["parent_policy"], job["parent_checkpoint_id"]) == ("fast@2", points[200])
    assert "both name the policy" in naoctl("submit", "--from-policy", "fast", "--from", "last", code=2)

    assert "best" in naoctl("policies", "delete", "fast@2", "--yes", code=6)
    assert "Deleted fast@1" in naoctl("policies", "delete", "fast@1", "--yes")
    assert "Deleted fast with all" in naoctl("policies", "delete", "fast", "--yes")
    assert "no policy 'fast'" in naoctl("policies", "show", "fast", code=5)
    shutil.rmtree(tmp_path / "fast-1")


def test_a_wait_for_results_states_what_it_waits_for(
    naoctl: Callable[..., str], trained: Lease, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No worker is there; the wait ends with its first note, as by Ctrl-C."""

    def note(context: Context, text: str) -> None:
        sys.stderr.write(text)
        raise KeyboardInterrupt

    monkeypatch.setattr(Context, "note", note)
    assert "Waiting: no worker" in naoctl("eval", trained.job_id, "--simulator", "server", code=130)


def test_a_job_is_meant_before_a_policy_of_its_name(
    naoctl: Callable[..., str], trained: Lease, run_job: Callable[..., Lease], tmp_path: Path
) -> None:
    naoctl("policies", "register", "shared", trained.job_id)
    naoctl("download", "shared", "--what", "checkpoint")
    assert (tmp_path / "shared-1" / "checkpoint").is_dir()
    run_job(name="shared")
    assert "no checkpoint yet" in naoctl("download", "shared", "--what", "checkpoint", code=5)
    naoctl("download", "shared@1", "--what", "checkpoint", "-o", "again")
    assert (tmp_path / "again" / "checkpoint").is_dir()
