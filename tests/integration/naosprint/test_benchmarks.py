"""Programs that measure what nothing else calls, with as little as they take."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

ROOT = Path(__file__).parents[3]
REAL = (
    pytest.mark.rcssserver3d,
    pytest.mark.skipif(shutil.which("rcssserver3d") is None, reason="no rcssserver3d in the search path"),
)


@pytest.mark.parametrize(
    ("command", "prints"),
    [
        ("benchmarks/learning/hopping.py t1-sprint", r"t1-sprint: 0\.\d{3}"),
        (
            "benchmarks/learning/kick_server.py t1-kick --kicks 1 --seed 1 --simulator embedded",
            "touched 1 of 1, upright 1",
        ),
        ("benchmarks/protocol/run.py --servers 1 --cycles 20 --rounds 1", r"truth / drained \d+%"),
        ("benchmarks/protocol/run_mujoco.py --rounds 1", r"driven / drained: \d+\.\d%, driven / syn: \d+\.\d%"),
        ("tools/gate_r2.py t1-run --episodes 1 --n-envs 1 --gate-only", "the gate asks for 200 episodes: not decided"),
        pytest.param("benchmarks/learning/onboard.py --episodes 1", r'"top_speed_mps": [34]\.', marks=REAL),
    ],
)
def test_a_program_measures(command: str, prints: str, tmp_path: Path) -> None:
    program, *words = command.split()
    run = subprocess.run([sys.executable, str(ROOT / program), *words], cwd=tmp_path, capture_output=True, text=True)
    assert re.search(prints, run.stdout), run.stderr
    assert "Traceback" not in run.stderr


@pytest.mark.parametrize(
    ("command", "prints"),
    [
        ("benchmarks/engine/run.py --cycles 100", "--cycles: '100': expected a number of 101 to 1,000,000,000"),
        ("benchmarks/learning/hopping.py sprint", "error: sprint: the robot is a nao-0, no Booster robot"),
        ("benchmarks/learning/hopping.py none", "error: 'none' is neither a checkpoint directory nor"),
        ("benchmarks/learning/kick_server.py t1-sprint", "error: t1-sprint: a policy of task sprint1, not of kick"),
        ("benchmarks/service/workers.py --seconds 0", "--seconds: '0': expected more than 0"),
        ("tools/getup_motion.py --minutes nan", "--minutes: 'nan': expected more than 0"),
        ("tools/getup_motion.py --robot nao-0 --output .", "error: --robot: nao-0 is no Booster robot"),
        ("tools/gate_kick.py t1-sprint", "error: t1-sprint: a policy of task sprint1, not of kick"),
        ("tools/rooms.py none", "error: Command "),
    ],
)
def test_a_program_says_in_a_line_what_it_cannot_do(command: str, prints: str, tmp_path: Path) -> None:
    program, *words = command.split()
    run = subprocess.run([sys.executable, str(ROOT / program), *words], cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode in (1, 2)
    assert prints in run.stderr.splitlines()[-1], run.stderr
    assert "Traceback" not in run.stderr


def test_a_gate_writes_its_points_also_of_robots_that_fell() -> None:
    """The speed after a stop has no median if half of them fell before."""
    points = "[at_most('stop', 'speed', float('inf'), 0.25), at_least('run', 'speed', float('nan'), 2.0)]"
    program = (
        "import dataclasses\nfrom naospec.json_text import json_text\nfrom points import at_least, at_most\n"
        f"for point in {points}:\n    print(json_text(dataclasses.asdict(point)), point)"
    )
    run = subprocess.run([sys.executable, "-c", program], cwd=ROOT / "tools", capture_output=True, text=True)
    assert run.stdout.count('"value": null') == run.stdout.count("FAIL") == 2, run.stderr


def test_a_motion_is_written_to_the_folder_that_is_given(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "tools/getup_motion.py"), "--sides", "front", "--minutes", "0.0001"]
    run = subprocess.run([*command, "--output", str(tmp_path / "motions")], capture_output=True, text=True)
    assert f"wrote {tmp_path}/motions/getup-t1.json" in run.stdout, run.stderr


def test_a_service_ends_with_the_program_that_is_terminated() -> None:
    service = "with stack.service_without_workers() as service: print(service.api.pid, flush=True); signal.pause()"
    command = [sys.executable, "-c", f"import signal, stack\n{service}"]
    with subprocess.Popen(command, cwd=ROOT / "benchmarks/service", stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        api = psutil.Process(int(program.stdout.readline()))
        program.terminate()
        assert program.wait(60) == 128 + signal.SIGTERM
    assert not api.is_running()


def test_a_study_and_some_sections_are_written_to_the_folder_that_is_given(tmp_path: Path) -> None:
    """Here they are drawn again from committed results, which stay as they are."""
    learning = ROOT / "benchmarks/learning"
    before = {path: path.read_bytes() for path in (learning / "teacher.png", learning / "sac.png")}
    for program, record in (("ablation.py teacher", "teacher.json"), ("run.py", "results.json")):
        shutil.copy(learning / record, tmp_path)
        name, *words = program.split()
        command = [sys.executable, str(learning / name), *words, str(tmp_path), "--only"]
        only = "plot" if words else "plots"
        subprocess.run([*command, only, "-o", str(tmp_path)], check=True, stdout=subprocess.DEVNULL)
    assert {path.suffix for path in tmp_path.iterdir()} == {".json", ".png"}
    assert all((tmp_path / path.name).is_file() and path.read_bytes() == data for path, data in before.items())
