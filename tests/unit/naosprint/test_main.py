"""The command line without the service."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import naopolicies
import pytest
from naospec import EvaluationSpec, TrainingSpec, plugins
from naospec.flat import OPTIONS, settings
from naosprint import commands
from naosprint.__main__ import _parser, main
from naosprint.analysis.results import summary_table
from naosprint.console import ConsoleReporter
from naosprint.rl.checkpoint import read_manifest
from rich.console import Console

SMALL = [
    *("--n-envs", "8", "--n-steps", "32", "--batch-size", "64", "--n-epochs", "2"),
    *("--hidden-sizes", "16,16", "--learner-threads", "1"),
]


def test_help_lists_every_setting(capsys: pytest.CaptureFixture[str]) -> None:
    """The options are the settings of all plug-ins, and the fields of an evaluation."""
    for command, names in (("train", settings()), ("evaluate", EvaluationSpec.model_fields)):
        with pytest.raises(SystemExit) as ended:
            main([command, "--help"])
        assert ended.value.code == 0
        text = capsys.readouterr().out
        for name in names:
            assert f"--{name.replace('_', '-')} VALUE" in text


def test_settings_of_plugins_take_no_option_of_the_command() -> None:
    """The other commands have no settings of plug-ins."""
    (commands,) = (action for action in _parser()._actions if isinstance(action.choices, dict))
    assert isinstance(commands.choices, dict)
    train = commands.choices["train"]
    own = [action for action in train._actions if not action.dest.startswith("setting_")]
    words = {word.lstrip("-").replace("-", "_") for action in own for word in (*action.option_strings, action.dest)}
    assert {word for word in words if len(word) > 1} <= OPTIONS


def test_broken_plugins_of_others_stop_no_command(broken: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["train", "--help"])
    assert ended.value.code == 0 and "--learning-rate" in capsys.readouterr().out
    assert main(["evaluate", "sprint", "--episodes", "1", "--bootstrap-resamples", "100"]) == 0
    assert "sprint" in capsys.readouterr().out
    for name, words in (("sinks", "no water"), ("dives", "uninstall all but one")):
        assert main(["train", "nowhere", "--task", name]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"error: {name}: package ") and words in line


def test_broken_plugins_are_shown_once(broken: Path) -> None:
    """Without the tests' own handlers of log messages, on standard error."""
    environment = {**os.environ, "PYTHONPATH": str(broken)}
    command = [sys.executable, "-m", "naosprint", "policies"]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert "t1-sprint" in ran.stdout
    told = ran.stderr.splitlines()
    assert len(told) == len(set(told)) and all(line.startswith("left out: ") for line in told)
    for package in ("sinking", "lame", "first-divers", "second-divers"):
        assert sum(f"package {package} " in line for line in told) == 1


def test_an_error_before_the_options_are_known_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise plugins.BrokenPluginError("swim: no water")

    monkeypatch.setattr("naosprint.__main__.settings", fail)
    assert main(["policies"]) == 1
    assert capsys.readouterr().err == "error: swim: no water\n"


def test_the_list_of_policies_is_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["policies"]) == 0
    lines = capsys.readouterr().out.splitlines()
    summaries = {line.split()[0]: naopolicies.card(line.split()[0])["summary"] for line in lines}
    assert len({line.index(summaries[line.split()[0]]) for line in lines}) == 1


def test_a_training_names_its_folder_as_it_is_called(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What looks like a style of the terminal, or the end of one, belongs to the name."""
    for name in ("[v2]", "runs[", "runs[/v2]"):
        with ConsoleReporter(tmp_path / name, TrainingSpec.model_validate({"total_steps": 256})) as reporter:
            reporter.checkpoint(Path(name) / "step-000000000256", 256)
        assert f"checkpoint at 256 steps: {name}/step-000000000256" in capsys.readouterr().err


def test_train_takes_the_job_file_of_the_service(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Options override it, and what cannot be trained without the service is refused."""
    job = tmp_path / "job.yaml"
    job.write_text(
        "name: night\nevaluation: null\n"
        "spec:\n  task: sprint2\n  seed: 4\n"
        "  algorithm: {n_envs: 8, n_steps: 32, batch_size: 64, n_epochs: 1, hidden_sizes: [8]}\n",
        encoding="utf-8",
    )
    assert main(["train", str(tmp_path / "run"), "--spec", str(job), "--total-steps", "256", "--seed", "5"]) == 0
    spec = read_manifest(Path(capsys.readouterr().out.split()[2])).spec
    assert (spec.task.name, spec.seed, spec.algorithm.hidden_sizes, spec.total_steps) == ("sprint2", 5, (8,), 256)
    for content, words in (
        ("seed: 4\n", "seed: no such field of a job"),
        ("parent_job_id: job_1\n", "parent_job_id: jobs are at the service"),
        ("spec:\n  algorithm: {gamma: 7}\n", "job.yaml: spec.algorithm.gamma: "),
    ):
        job.write_text(content, encoding="utf-8")
        assert main(["train", str(tmp_path / "other"), "--spec", str(job)]) != 0
        assert words in capsys.readouterr().err


def test_train_resume_evaluate_report_and_export(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Train, evaluate, report and export."""
    work = tmp_path / "run"
    assert main(["train", str(work), "--total-steps", "512", "--sensor-digits", "none", *SMALL]) == 0
    status, steps, path = capsys.readouterr().out.split()
    assert (status, steps) == ("finished", "512")
    spec = read_manifest(Path(path)).spec
    assert (spec.algorithm.n_envs, spec.algorithm.hidden_sizes) == (8, (16, 16))
    assert spec.simulator.sensor_digits is None
    rows = [json.loads(line) for line in (work / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [256, 512]

    assert main(["train", str(work), "--resume", path, "--total-steps", "1024"]) == 0
    status, steps, path = capsys.readouterr().out.split()
    assert (status, steps) == ("finished", "1024")

    assert main(["evaluate", path, "--episodes", "3", "--json", "--output", str(tmp_path / "out")]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert printed["episodes"] == 3
    assert main(["evaluate", path, "--episodes", "3"]) == 0
    title, heading, first, *_ = (line.strip() for line in capsys.readouterr().out.splitlines() if line.strip())
    assert title == "sprint1, nao-0, embedded: 3 episodes"
    assert heading.split("  ")[0] == "Result" and "95 % interval" in heading
    assert first.split("  ")[0] == "Top speed", "the task's main result"

    arguments = ["report", str(tmp_path / "out"), str(tmp_path / "page"), "--metrics", str(work / "metrics.jsonl")]
    assert main([*arguments, "--no-film", "--title", "Run 1"]) == 0
    page = Path(capsys.readouterr().out.strip())
    assert "<title>Run 1</title>" in page.read_text(encoding="utf-8")
    assert main([*arguments, "--no-film"]) == 0
    assert "<title>sprint1</title>" in page.read_text(encoding="utf-8")
    capsys.readouterr()

    assert main(["export", path, str(tmp_path / "policy")]) == 0
    names = [Path(line).name for line in capsys.readouterr().out.splitlines()]
    assert names[:5] == ["policy.npz", "policy.onnx", "policy.json", "policy.h", "policy_check.c"]


def test_replay_films_as_much_as_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The film may be shorter than the run; the replay is complete."""
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    assert main(["replay", "sprint", str(tmp_path), "--film-seconds", "0.1"]) == 0
    names = [Path(line).name for line in capsys.readouterr().out.splitlines()]
    assert names == ["replay.json", "replay.npz", "replay.mp4"]
    assert imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "replay.mp4"))[0] == 5
    assert json.loads((tmp_path / "replay.json").read_text())["frames"] > 50
    assert main(["replay", "sprint", str(tmp_path), "--no-film"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["replay.json", "replay.npz"], "no film of another run"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["evaluate", "sprint", "--threads", "0"], "--threads: '0': expected a number of 1 to 256"),
        (["handover", "--seed", "-1"], "--seed: '-1': expected a number of 0 to"),
        (["handover", "--threads", "-1"], "--threads: '-1': expected a number of 1 to 256"),
        (["replay", "sprint", "x", "--film-seconds", "0"], "--film-seconds: '0': expected more than 0"),
        (["replay", "sprint", "x", "--film-seconds", "inf"], "--film-seconds: 'inf': expected more than 0"),
    ],
)
def test_numbers_that_make_no_sense_are_refused_by_flag(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(arguments)
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        ["evaluate", "sprint", "--output"],
        ["examine", "sprint", "--output"],
        ["handover", "--output"],
        ["replay", "sprint"],
    ],
)
def test_an_output_that_cannot_be_written_is_refused_before_anything_is_computed(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("evaluation.evaluate", "examination.examine", "transitions.matrix"):
        monkeypatch.setattr(f"naosprint.analysis.{module}", pytest.fail)
    (tmp_path / "file").write_text("")
    # the second is a folder that exists, in which no file can be made
    for output, named in ((tmp_path / "file" / "x", tmp_path / "file"), ("/proc/self", "/proc/self")):
        assert main([*arguments, str(output)]) == 1
        assert str(named) in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["team", "x", "--team", "other"], "--team: expected 'example' with or without policies of its skills"),
        (["match", "report", __file__], "test_main.py: not the log of a game"),
        (["match", "report", "game-9.npz"], "game-9.npz: there is no such log; `naosprint match` writes game-001.npz"),
        (["match", "film", "game-9.npz"], "game-9.npz: there is no such log; `naosprint match` writes game-001.npz"),
        (["match", "example", "example", "--cpu-seconds", "-1"], "cpu_seconds: must be at least 1, not -1"),
        (["train", __file__], "test_main.py: is a file, not a folder"),
        (["train", "x", "--task", "swim"], "--task: unknown task 'swim': choose one of "),
        (["train", "x", "--n-envs", "many"], "--n-envs: "),
        (["train", "x", "--min-height-m", "-1"], "--min-height-m: "),
        (["train", "x", "--batch-size", "7"], "--batch-size: 7 does not divide"),
        (["train", "x", "--n-envs", "7"], "algorithm.batch_size: 2048 does not divide"),
        (["train", "x", "--symmetric-policy=maybe"], "--symmetric-policy: expected true or false, got 'maybe'"),
        (["train", "x", "--simulator", "gazebo"], "--simulator: unknown simulator 'gazebo'"),
        (
            ["train", "x", "--simulator", "server", "--n-envs", "2", "--n-steps", "64", "--batch-size", "128"],
            "NAOSPRINT_SIMSERVER: there is no program 'no-such-server'",
        ),
        (["train", "x", "--simulator", "server", "--n-envs", "4096"], "n_envs: 4096 robots need as many servers"),
        (["evaluate", "nowhere"], "'nowhere' is neither a checkpoint directory nor a bundled policy"),
        (["evaluate", "nowhere", "--episodes", "0"], "--episodes: "),
        (["evaluate", "nowhere", "--task", "swim"], "--task: unknown task 'swim'"),
        (["evaluate", "nowhere", "--task", '{"name": "velocity", "wings": 2}'], "--task: wings: velocity has no such"),
        (["evaluate", "nowhere", "--deterministic=2"], "--deterministic: expected true or false, got '2'"),
        (["train", "x", "--resume", "nowhere"], "not a checkpoint"),
        (["train", "x", "--resume", "t1-kick"], "--resume: t1-kick is a bundled policy, no training; start from it: "),
        (["report", "nowhere", "page"], "nowhere: no complete evaluation"),
        (["export", "nowhere", "policy"], "neither a checkpoint directory nor a bundled policy"),
        (["replay", ".", "policy"], "not a checkpoint"),
    ],
)
def test_bad_input_is_explained(
    arguments: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """An exit status and one line, no traceback."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NAOSPRINT_SIMSERVER", "no-such-server")
    assert main(arguments) in (1, 2)
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_saves_a_checkpoint(tmp_path: Path, number: signal.Signals) -> None:
    """Ctrl-C and SIGTERM leave a checkpoint that can be resumed."""
    work = tmp_path / "run"
    process = subprocess.Popen(
        [sys.executable, "-m", "naosprint", "train", str(work), "--total-steps", "100000000", *SMALL],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TERM": "dumb"},
    )
    assert process.stderr is not None
    # the first checkpoint is announced when training has begun
    for line in process.stderr:
        if "checkpoint at 0 steps" in line:
            break
    process.send_signal(number)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    status, steps, path = output.split()
    assert status == "stopped"
    assert read_manifest(Path(path)).steps == int(steps)


@pytest.mark.parametrize(
    ("command", "number"),
    [
        ("evaluate {checkpoint} --episodes 100000 --output {folder}", signal.SIGTERM),
        ("examine {checkpoint} --episodes 100000 --output {folder}", signal.SIGINT),
        ("handover --transitions 100000 --output {folder}/handover.json", signal.SIGTERM),
    ],
    ids=lambda value: str(value).split()[0],
)
def test_an_interrupt_is_one_line_and_leaves_no_file(
    checkpoint: Path, tmp_path: Path, command: str, number: signal.Signals
) -> None:
    """Once the output's folder is there, which is made first."""
    folder = tmp_path / "output"
    words = command.format(checkpoint=checkpoint, folder=folder).split()
    process = subprocess.Popen([sys.executable, "-m", "naosprint", *words], stderr=subprocess.PIPE, text=True)
    while not folder.exists():
        with contextlib.suppress(subprocess.TimeoutExpired):
            pytest.fail(f"ended with {process.wait(0.01)}")
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert errors.strip() == f"stopped by {number.name}; no unfinished file is left"
    assert process.returncode == 128 + number
    assert not list(folder.iterdir())


def test_an_interrupt_that_another_error_hides_is_one(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As an import of compiled code does; the program then ends by itself, not by a signal of Python's."""

    def hide(_options: object) -> int:
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt as error:
            assert type(error) is not KeyboardInterrupt
            raise ImportError("initialization failed") from error
        return 0

    hide.__name__ = "policies"
    monkeypatch.setattr(commands, "policies", hide)
    assert main(["policies"]) == 128 + signal.SIGTERM
    assert capsys.readouterr().err == "stopped by SIGTERM; no unfinished file is left\n"


def test_a_full_disk_leaves_all_files_or_those_before(checkpoint: Path, tmp_path: Path) -> None:
    """Of an evaluation that replaces another, of which the first file fits; of an export and of a team."""
    arguments = ["evaluate", str(checkpoint), "--episodes", "2", "--bootstrap-resamples", "100", "--output"]
    assert main([*arguments, str(tmp_path)]) == 0
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    fits = (tmp_path / "evaluation.json").stat().st_size + 200
    assert fits < (tmp_path / "replay.json").stat().st_size
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (fits, limits[1]))
    try:
        assert main([*arguments, str(tmp_path), "--seed", "8"]) == 1
        assert main(["export", str(checkpoint), str(tmp_path / "policy"), "--format", "numpy"]) == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert {path: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == before
    assert not list((tmp_path / "policy").iterdir())


def test_a_matrix_of_transitions_is_whole_and_a_pipe_stays_one(tmp_path: Path) -> None:
    """A link, such as /dev/stdout, stays one, too."""
    arguments = ["handover", "--only", "walk", "--transitions", "1", "--engine", "fast", "--output"]
    file, link, pipe = tmp_path / "file", tmp_path / "link", tmp_path / "pipe"
    file.write_text("before")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20, limits[1]))
    try:
        assert main([*arguments, str(file)]) == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert file.read_text() == "before" and list(tmp_path.iterdir()) == [file]
    link.symlink_to(file)
    os.mkfifo(pipe)
    with os.fdopen(os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)) as reader:
        assert main([*arguments, str(pipe)]) == 0
        found = json.loads(reader.read())
    assert found["policies"] == {"walk": "t1-run"}
    assert main([*arguments, str(link)]) == 0
    assert link.is_symlink() and json.loads(file.read_text()) == found


def test_two_trainings_do_not_share_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Their metrics and checkpoints would mix."""
    with ConsoleReporter(tmp_path, TrainingSpec.model_validate({"total_steps": 256})):
        assert main(["train", str(tmp_path), "--total-steps", "256", *SMALL]) == 1
        assert f"error: {tmp_path}: another process trains in this folder; use another" in capsys.readouterr().err
        assert not (tmp_path / "metrics.jsonl").read_text()
    assert main(["train", str(tmp_path), "--total-steps", "256", *SMALL]) == 0


def test_another_charset_changes_no_file(checkpoint: Path, tmp_path: Path) -> None:
    """In a locale of ISO-8859-1, or of ASCII, files are UTF-8 and the terminal shows what it can."""
    environment = {**os.environ, "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONWARNDEFAULTENCODING": "1"}
    environment.pop("PYTHONIOENCODING", None)
    for locale in ("C", "en_US.ISO-8859-1"):
        for words in (
            ("evaluate", checkpoint, "--episodes", "2", "--n-envs", "2", "--output", tmp_path / locale / "evaluation"),
            ("report", tmp_path / locale / "evaluation", tmp_path / locale / "out", "--no-film", "--title", "\u4e09 a"),
            ("export", checkpoint, tmp_path / locale / "export", "--format", "c"),
        ):
            done = subprocess.run(
                [sys.executable, "-P", "-m", "naosprint", *map(str, words)],
                env={**environment, "LC_ALL": locale, "LANG": locale},
                capture_output=True,
                check=False,
            )
            assert done.returncode == 0, done.stderr.decode(errors="replace")
        assert (tmp_path / locale / "out/report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["examine", "sprint", "--episodes", "1", "--only", "motion"], "--only: motion: cannot be examined"),
        (["handover", "--only", "getup", "--transitions", "1", "--engine", "fast"], "--only: getup: no transition"),
        (["evaluate", "t1-run", "--task", "kick", "--episodes", "1"], "ball_left; tasks that fit it: velocity\n"),
    ],
)
def test_a_choice_of_which_nothing_is_left_is_refused(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """It printed an empty table, or nothing, and succeeded."""
    assert main(arguments) == 1
    assert words in capsys.readouterr().err


def test_a_setting_that_the_policys_robot_lacks_is_named_by_its_flag(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "sprint", "--engine", "fast"]) == 2
    assert capsys.readouterr().err.startswith("--engine: embedded with robot nao-0 has no such setting")


def test_a_reader_that_ends_early_is_no_error() -> None:
    """As of `naosprint policies | head -1`; nor is a closed standard output."""
    command = [sys.executable, "-P", "-m", "naosprint", "policies"]
    reader, writer = os.pipe()
    os.close(reader)
    try:
        ended = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    finally:
        os.close(writer)
    assert (ended.returncode, ended.stderr) == (128 + signal.SIGPIPE, "")
    closed = subprocess.run(["sh", "-c", '"$@" >&-', "sh", *command], capture_output=True, text=True, check=False)
    assert (closed.returncode, closed.stderr) == (0, "")
    full = subprocess.run(["sh", "-c", '"$@" >/dev/full', "sh", *command], capture_output=True, text=True, check=False)
    assert full.returncode == 1
    assert full.stderr.startswith("error: standard output: No space left on device\n")


def test_what_a_training_is_resumed_with_has_to_be_what_it_was(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A recipe or a job file that differs is refused; the policy that the training started from is behind it."""
    work, spec = tmp_path / "work", tmp_path / "job.json"
    begun = read_manifest(checkpoint).spec.model_dump(mode="json")
    resume = ["train", str(work), "--resume", str(checkpoint)]
    assert main([*resume, "--recipe", "t1-sprint"]) == 1
    words = "algorithm.batch_size: the checkpoint was trained with 64, the specification has 2048"
    assert words in capsys.readouterr().err
    spec.write_text(json.dumps({"spec": {**begun, "total_steps": 1024}, "parent_policy": "sprint"}), encoding="utf-8")
    for options in (["--spec", str(spec)], ["--steps", "1024", "--from-policy", "sprint"]):
        assert main([*resume, *options]) == 0
        assert capsys.readouterr().out.startswith("finished 1024")


def test_a_folder_of_another_training_is_refused(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Metrics and checkpoints of both would mix."""
    shutil.copytree(checkpoint, tmp_path / "work" / checkpoint.name)
    assert main(["train", str(tmp_path / "work"), "--seed", "7"]) == 1
    assert "has checkpoints of another specification" in capsys.readouterr().err
    spec = tmp_path / "again.json"
    spec.write_text(json.dumps({"spec": read_manifest(checkpoint).spec.model_dump(mode="json")}), encoding="utf-8")
    assert main(["train", str(tmp_path / "work"), "--spec", str(spec)]) == 1
    resume = f"--resume {tmp_path / 'work' / checkpoint.name}"
    assert f"has checkpoints of this training already; continue it with {resume}" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "work").iterdir()] == [checkpoint.name]


def test_an_evaluation_of_a_task_that_summarizes_nothing_has_a_reason(capsys: pytest.CaptureFixture[str]) -> None:
    about = {"task": {"name": "hop"}, "evaluation": {"confidence": 0.95}, "episodes": 3}
    Console(width=80).print(summary_table({**about, "headline": [], "results": []}))
    assert "none: the task has no method `summarize`" in capsys.readouterr().out
