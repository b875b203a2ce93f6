"""Messages of a server's monitor port, from the package's own simulation."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import pytest
from naosim import robots
from naosprint.matches.log import CLIP_FRAMES, GameLog, HalfRecorder, joined
from naosprint.matches.stream import PLAY_MODES, Frame, Stream, StreamError
from rcsssmj.games.soccer.play_mode import PlayMode
from rcsssmj.games.soccer.sim.soccer_referee import SoccerReferee
from rcsssmj.games.soccer.sim.soccer_sim import SoccerSimulation
from rcsssmj.games.soccer.soccer_fields import create_soccer_field
from rcsssmj.games.soccer.soccer_rules import create_soccer_rule_book
from rcsssmj.server.remote_monitor import RSMPMonitor

PLAYERS = [("left", 1), ("right", 1)]


class Messages(RSMPMonitor):
    """The package's monitor, which keeps its messages."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []

    def _emit_message(self, message: str) -> None:
        self.texts.append(message)


@dataclass(frozen=True)
class Parameters:
    """What an agent asks for."""

    team_name: str
    player_no: int
    model_name: str = "T1"


@pytest.fixture
def game(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[SoccerSimulation, Messages]:
    monkeypatch.chdir(tmp_path)  # MuJoCo logs there that a robot's first targets are not numbers
    rules = create_soccer_rule_book("ssim")
    simulation = SoccerSimulation(create_soccer_field(rules.default_field_version.value), rules, SoccerReferee())
    assert simulation.init()
    simulation.step([])  # robots enter after the first cycle
    simulation.add_players([Parameters(*player) for player in PLAYERS])
    return simulation, Messages()


def test_poses_and_state_are_those_of_the_simulation(game: tuple[SoccerSimulation, Messages]) -> None:
    simulation, monitor = game
    stream = Stream()
    data, model = simulation.mj_data, simulation.mj_model
    rng = np.random.default_rng(0)
    joints = [model.jnt_qposadr[j] for j in range(model.njnt) if model.jnt_type[j] == 3]
    recorder = HalfRecorder([(0, 1), (1, 1)], PLAYERS, left=0)
    angles = []
    for _ in range(4):
        data.qpos[joints] = rng.uniform(-0.3, 0.3, len(joints))
        simulation.step([])
        simulation.step([])
        mujoco.mj_kinematics(model, data)
        angles.append(data.qpos[joints].reshape(2, -1).copy())
        monitor.update(simulation.generate_state_information(), 2 * (len(angles) + 125), simulation.last_recompilation)
        frame = stream.read(monitor.texts[-1])
        recorder.add(frame)
    assert "diff" in monitor.texts[-1]
    assert set(frame.bodies) == set(PLAYERS)
    assert PLAY_MODES[frame.mode] == "BeforeKickOff"
    for player, torso in zip(PLAYERS, ("left", "right"), strict=True):
        assert len(frame.bodies[player]) == 24, torso
    log = joined([recorder], ("a", "b"), {})
    # entries that change by less than 0.005 are not sent
    np.testing.assert_allclose(log.joints_rad[-1], angles[-1], atol=0.012)
    bodies = [i for i in range(model.nbody) if model.body(i).name.endswith("torso")]
    np.testing.assert_allclose(log.torso_m[-1], data.xpos[bodies], atol=0.006)
    np.testing.assert_allclose(np.abs((log.quaternion[-1] * data.xquat[bodies]).sum(axis=1)), 1.0, atol=1e-3)
    assert log.joints_rad.shape[2] == len(robots.get("t1").joints)


@pytest.mark.parametrize(("played", "first", "expected"), [(60, 0, (0, 4)), (60, 21, (22, 2)), (12, 0, (0, 2))])
def test_a_running_game_is_shown_by_a_log_of_its_last_frames(
    tmp_path: Path, played: int, first: int, expected: tuple[int, int]
) -> None:
    recorder = HalfRecorder([(0, 1), (1, 1)], PLAYERS, left=1)
    bodies = np.tile(np.vstack([np.eye(3), np.zeros(3)]).astype(np.float32), (24, 1, 1))
    for frame in range(played):
        bodies[0, 3] = [0.1 * frame, 1.0, 0.6]
        ball = np.array([0.05 * frame, 0.0, 0.11])
        found = {PLAYERS[0]: bodies.copy()}
        recorder.add(Frame(0.04 * frame, 280.0 + 0.04 * frame, 3, (1, 0), ball, found))
    (path := tmp_path / "clip.npz").write_bytes(base64.b64decode(recorder.clip(first, ("a", "b"), 1, (2, 3))))
    clip = GameLog.load(path)
    start, step = expected
    shown = np.arange(start, played, step)
    assert (clip.notes["first"], clip.notes["step"]) == expected
    assert len(shown) <= CLIP_FRAMES
    np.testing.assert_allclose(clip.ball_m[:, 0], 0.05 * shown, atol=1e-3)
    np.testing.assert_allclose(clip.torso_m[:, 0, 0], 0.1 * shown, atol=1e-3)
    np.testing.assert_allclose(clip.clock_s, 0.04 * shown, atol=1e-4)
    assert clip.goals == (2, 4)
    assert clip.present.tolist() == [[True, False]] * len(shown)


def test_before_the_first_frame_and_without_a_new_one_nothing_is_shown() -> None:
    recorder = HalfRecorder([(0, 1), (1, 1)], PLAYERS, left=0)
    assert recorder.clip(0, ("a", "b"), 0, (0, 0)) == ""


def test_modes_are_those_of_the_package() -> None:
    assert [mode.value for mode in PlayMode] == list(PLAY_MODES)


def test_other_messages_are_refused() -> None:
    with pytest.raises(StreamError, match="not a message"):
        Stream().read("((RSMP 1 0))")
