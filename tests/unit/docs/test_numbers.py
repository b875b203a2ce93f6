"""Jobs, step counts and folders in the documents match their commands."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from typing import Any

import naopolicies
import pytest
from naoctl.cli import build_app
from naoctl.commands.artifacts import REPORT_PAGE
from naoctl.commands.submit import make_body
from naoctl.errors import ExitCode, InvalidInput
from naospec import TrainingSpec
from naospec.job_files import load_job_file
from naosprint_api.schemas.jobs import JobCreate
from typer.testing import CliRunner

from . import documents
from .documents import ROOT, Command

SUBMITS = [command for command in documents.commands() if command.words[:2] == ("naoctl", "submit")]
STEPS = re.compile(r"(?:checkpoint|export)-0*(\d+)|of ([\d,]+) steps")
"""Steps in the names of checkpoints and in progress lines."""


def dry_run(words: tuple[str, ...], folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.chdir(folder)
    done = CliRunner().invoke(build_app(words[1]), [*words[1:], *([] if "--dry-run" in words else ["--dry-run"])])
    assert done.exit_code == 0, f"{shlex.join(words)}: {done.output}{done.exception}"
    printed: dict[str, Any] = json.loads(done.stdout)
    return printed.get("job", printed)


def write_job_files(document: Path, folder: Path) -> None:
    """Write the files in a document: blocks whose first line is a comment with the name."""
    for language in ("yaml", "toml"):
        for text in documents.blocks(document, language):
            if name := re.match(r"# ([\w-]+\.(?:yaml|toml))\n", text):
                (folder / name[1]).write_text(text)


@pytest.mark.parametrize("command", SUBMITS, ids=str)
def test_every_submit_in_the_documents_is_a_job(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_job_files(ROOT / command.document, tmp_path)
    job = dry_run(command.words, tmp_path, monkeypatch)
    assert TrainingSpec.model_validate(job["spec"]).planned_steps == job["spec"]["total_steps"]


@pytest.mark.parametrize(
    "name", ["README.md", "docs/tutorial.md", "docs/how-to/export.md", "docs/how-to/rcssservermj.md"]
)
def test_step_counts_are_those_of_the_documents_own_jobs(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A training of 3 million steps ends at a whole rollout, and its checkpoint has that name."""
    write_job_files(ROOT / name, tmp_path)
    usual = ("naoctl", "submit", "--steps", "3000000")  # the training of `make demo`
    planned = {
        dry_run(words, tmp_path, monkeypatch)["spec"]["total_steps"]
        for words in [usual, *(command.words for command in SUBMITS if command.document == name)]
    }
    shown = {int((match[1] or match[2]).replace(",", "")) for match in STEPS.finditer((ROOT / name).read_text("utf-8"))}
    assert shown <= planned, f"{name} shows {shown - planned}, its jobs have {planned}"


def test_the_report_is_in_the_folder_that_the_tutorial_names() -> None:
    text = (ROOT / "docs" / "tutorial.md").read_text("utf-8")
    (line,) = [line for line in text.splitlines() if line.startswith("naoctl report ")]
    command, page = line.split("#")[0].split(), line.rsplit(" ", 1)[1]
    assert page == f"{command[command.index('-o') + 1]}/report/{REPORT_PAGE}"


def test_the_curl_example_is_a_job() -> None:
    (text,) = (block for block in documents.blocks(ROOT / "README.md", "sh") if "curl -X POST" in block)
    body = re.search(r"-d '(.*?)'", text, re.DOTALL)
    assert body is not None
    assert JobCreate.model_validate(json.loads(body[1])).spec.total_steps == 3_000_000


def test_the_job_file_of_the_tutorial_is_a_job(tmp_path: Path) -> None:
    write_job_files(ROOT / "docs" / "tutorial.md", tmp_path)
    job = JobCreate.model_validate(make_body(load_job_file(tmp_path / "night.yaml"), {"seed": "3"}, {}))
    assert (job.name, job.spec.algorithm.preset, job.spec.seed) == ("night", "paper", 3)


def test_the_tutorials_table_has_every_exit_code() -> None:
    text = (ROOT / "docs" / "tutorial.md").read_text("utf-8")
    numbers = {int(number) for row in re.findall(r"^\| ([\d, ]+) \|", text, re.MULTILINE) for number in row.split(",")}
    assert numbers == {int(code) for code in ExitCode}


def test_the_error_that_the_tutorial_shows_is_the_real_one() -> None:
    text = (ROOT / "docs" / "tutorial.md").read_text("utf-8")
    (shown,) = re.findall(r"^\$ naoctl (submit .*)\nnaoctl: (.*)$", text, re.MULTILINE)
    with pytest.raises(InvalidInput) as caught:
        CliRunner().invoke(build_app(), shlex.split(shown[0]), catch_exceptions=False, standalone_mode=False)
    assert str(caught.value) == shown[1]


def results(path: str) -> Any:
    return json.loads((ROOT / "benchmarks" / path).read_text("utf-8"))


@pytest.mark.parametrize("name", ["README.md", "docs/policies/index.md"])
def test_tables_of_policies_state_the_results_on_their_cards(name: str) -> None:
    """Every number with a decimal or in percent after a link to a policy's page is one of its results, rounded."""
    checked = set()
    for shown, page, after in re.findall(
        r"\[([^\]]*)\]\((?:docs/policies/)?([\w-]+)\.md\)([^|;·\[]*)", (ROOT / name).read_text("utf-8")
    ):
        if page in naopolicies.names():
            card = naopolicies.card(page)
            rows = [card["results"], *(row["results"] for row in card.get("robustness") or ())]
            values = [one["value"] for row in rows for one in row if one["value"] is not None]
            for number in re.findall(r"\d+\.\d+|\d+(?=(?: and \d+)? %)", shown + after):
                digits = len(number.partition(".")[2])
                known = {f"{scale * value:.{digits}f}" for value in values for scale in (1, 100)}
                assert number in known, f"{page}: {number}"
                checked.add(page)
    assert len(checked) >= 5


DISTURBED = {
    "pushes of 1 m/s": "pushes of up to 1 m/s every 2 s",
    "20 ms more delay": "20 ms more delay",
    "noise on all sensors": "sensor noise (0.5 degrees, 5 deg/s, 5 mm)",
    "friction times 0.6": "friction times 0.6",
    "1 cm of noise on the ball": "1 cm of noise on the ball",
    "the first four and masses at once": "the first five at once",
}
"""By row of the table of kicks, what the card calls its disturbance."""
ROWS = {
    "falls; upright": ("fall_rate", "upright_rate"),
    "corridor of 5 m": ("corridor_5_rate",),
    "direction error, median / 90th percentile": ("stop_error_deg", "stop_error_90_deg"),
    "distance error; power kick": ("distance_error", "power_distance_m"),
    "along the first line": ("line_rate",),
    "around the corner and along the second": ("corner_rate",),
    "ball never more than 0.8 m ahead": ("kept_rate",),
    "speed on the line": ("course_speed_mps",),
    "falls": ("fall_rate",),
    **dict.fromkeys(DISTURBED, ("upright_rate", "corridor_5_rate")),
}
"""By row of the tables that compare two policies, the results in its cells."""


def test_the_page_of_kicks_states_the_results_on_the_cards() -> None:
    """Every result in a table with a column for each of two policies, and what a K1 does when all disturb it."""
    text = (ROOT / "docs" / "how-to" / "kick.md").read_text("utf-8")
    checked = 0
    for first, second, body in re.findall(r"^\| \| `([\w-]+)` \| `([\w-]+)` \|\n((?:\|.*\n)+)", text, re.MULTILINE):
        for label, *cells in (line.strip("| ").split(" | ") for line in body.splitlines()):
            for policy, cell in zip((first, second), cells, strict=True) if label in ROWS else ():
                card = naopolicies.card(policy)
                rows = {row["disturbance"]: row["results"] for row in card["robustness"]}
                row = rows[DISTURBED[label]] if label in DISTURBED else card["results"]
                found = {one["name"]: one["value"] for one in row}
                for name, shown in zip(ROWS[label], re.findall(r"\d+(?:\.\d+)?", cell), strict=True):
                    scale = 100 if name.endswith("rate") or name == "distance_error" else 1
                    assert shown == f"{scale * found[name]:.{len(shown.partition('.')[2])}f}", f"{policy}: {label}"
                    checked += 1
    assert checked == 2 * (7 + 2 * 6 + 5)
    (shown,) = re.findall(r"at once it is upright in (\d+) %", text.replace("\n", " "))
    results = {row["disturbance"]: row["results"] for row in naopolicies.card("k1-kick")["robustness"]}
    (upright,) = (one["value"] for one in results["the first five at once"] if one["name"] == "upright_rate")
    assert shown == f"{100 * upright:.0f}"


def test_the_results_of_the_accuracy_page_are_those_that_were_measured() -> None:
    """Every number of its table that has a record is rounded from it."""
    text = (ROOT / "docs" / "explanation" / "accuracy.md").read_text("utf-8")
    engine = results("engine/results.json")["results"]
    policy = {result["name"]: result["value"] for result in naopolicies.card("sprint")["results"]}
    (cycles, ratio, apart) = re.search(
        r"about ([\d,]+) cycles .*?, (\d+) times libode .*? by (\d+)e-11 m", text
    ).groups()
    found = [row for row in engine if row["robot_type"] < 4]
    assert int(cycles.replace(",", "")) == pytest.approx(min(row["naosim_cycles_per_s"] for row in found), rel=0.01)
    assert int(ratio) == round(sum(row["times_libode"] for row in found) / len(found))
    assert int(apart) == round(sum(row["torso_apart_max_m"] for row in found) / len(found) * 1e11)
    assert f"top speed {policy['top_speed_mps']:.2f} m/s" in text
    assert f"with {policy['fall_rate']:.1%} falls".replace("%", " %") in text
    for name in ("sprint-hour", "t1-sprint", "k1-sprint-fast"):
        bundled = {result["name"]: result["value"] for result in naopolicies.card(name)["results"]}
        (row,) = (line for line in text.splitlines() if f"`{name}`" in line)
        assert f"{bundled['top_speed_mps']:.2f}" in row and f"{100 * bundled['fall_rate']:.1f}" in row
    (least,) = re.findall(r"training runs at ([\d,]+) to [\d,]+ steps a second on 2 cores", text)
    throughput = results("learning/results.json")["throughput"]["whole_loop"]
    assert int(least.replace(",", "")) == pytest.approx(throughput, rel=0.03)
    protocol = (ROOT / "benchmarks" / "protocol" / "README.md").read_text("utf-8")
    (row,) = re.findall(r"^\| 4 . rcssserver3d \| ([\d,]+) \| ([\d,]+) \|$", protocol, re.MULTILINE)
    (shown,) = re.findall(r"on four real servers, .*? at ([\d,]+) to ([\d,]+) steps a second", text)
    assert [round(int(value.replace(",", "")), -2) for value in row] == [int(value.replace(",", "")) for value in shown]
