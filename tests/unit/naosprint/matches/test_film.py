"""Films of games that are made up here."""

from __future__ import annotations

import argparse
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from naosprint.matches.commands import add_parsers
from naosprint.matches.film import HEIGHT_PX, WIDTH_PX, GameFilm, goal_frames, write_game_film
from naosprint.matches.log import GameLog
from numpy.typing import NDArray

from tests.unit.naosprint.matches.test_results import game

WHITE, BLUE, ORANGE = (250, 250, 245), (51, 120, 199), (222, 115, 33)


def close_up() -> GameLog:
    """Return a game of two robots that stand beside the ball."""
    log = game(n=200)
    log.torso_m[:, 0, 0], log.torso_m[:, 1, 0] = -2.0, 2.0
    return log


def places(picture: NDArray[np.uint8], colour: tuple[int, int, int]) -> NDArray[np.int64]:
    """Return (k, 2) row and column of the pixels of a colour, shaded or not, below the scoreboard."""
    pixels = picture[50:].astype(float)
    bright = pixels.sum(axis=2, keepdims=True) / sum(colour)
    same = np.abs(pixels - bright * colour).max(axis=2) < 12.0
    return np.argwhere(same & (bright[..., 0] > 0.55) & (bright[..., 0] < 1.05))


def test_a_picture_shows_robots_in_their_colours_where_they_are() -> None:
    log = close_up()
    picture = GameFilm(log).picture(10)
    assert picture.shape == (HEIGHT_PX, WIDTH_PX, 3)
    blue, orange = places(picture, BLUE), places(picture, ORANGE)
    assert min(len(blue), len(orange)) > 100
    # team 0 stands to the left of the ball, in the middle of the picture, and team 1 to the right
    assert blue[:, 1].mean() < WIDTH_PX / 2 - 50
    assert orange[:, 1].mean() > WIDTH_PX / 2 + 50
    log.present[:, 1] = False
    assert len(places(GameFilm(log).picture(10), ORANGE)) < 20


def test_a_robot_that_lies_is_drawn_so() -> None:
    log = close_up()
    standing = places(GameFilm(log).picture(10), BLUE)
    log.torso_m[:, 0, 2] = 0.15
    log.quaternion[:, 0] = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
    lying = places(GameFilm(log).picture(10), BLUE)
    assert lying[:, 0].min() > standing[:, 0].min() + 15


def test_the_camera_follows_the_ball_and_cuts_at_half_time() -> None:
    log = close_up()
    log.ball_m[:100, 0] = 20.0
    film = GameFilm(log)
    assert len(places(film.picture(95), BLUE)) == 0
    assert len(places(film.picture(100), BLUE)) > 100


def test_the_frames_of_goals_are_chosen_once_and_end_with_the_half() -> None:
    log = game(n=1000)
    log.score[:] = 0
    log.score[300:, 0] = 1
    log.score[490:, 1] = 1
    assert goal_frames(log) == list(range(300 - 200, 500))
    assert goal_frames(game()) == []


def test_a_film_of_a_log_plays_in_real_time(tmp_path: Path) -> None:
    log = close_up()
    write_game_film(log, tmp_path / "match.mp4", frames=range(10))
    pictures, seconds = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "match.mp4"))
    assert (pictures, seconds) == (10, pytest.approx(0.4, abs=0.02))


def test_only_a_match_asks_itself_whether_to_stop(tmp_path: Path) -> None:
    """Ctrl-C ends a film or a report at once."""
    parser = argparse.ArgumentParser()
    add_parsers(parser.add_subparsers(), lambda: pytest.fail("signals would be ignored"))
    for command in ("film", "report"):
        options = parser.parse_args(["match", command, str(tmp_path / "none.npz")])
        with pytest.raises(ValueError, match="there is no such log"):
            options.run(options)


def test_a_film_can_be_stopped(tmp_path: Path) -> None:
    class StoppedError(Exception):
        pass

    def stop() -> None:
        raise StoppedError

    with pytest.raises(StoppedError):
        write_game_film(close_up(), tmp_path / "match.mp4", stop=stop)
    assert not list(tmp_path.iterdir())
