"""Frames per second at which a browser draws a game in three dimensions, with 2, 6 and 14 robots.

    python benchmarks/matches/draw.py --robots 2 6 14 --seconds 5
    python benchmarks/matches/draw.py --log match/game-001.npz --pictures build

Starts a headless Chromium on the dashboard's own module `game3d.js` and its style, and plays a game in real time: the
log that is given, or one in which all robots run on circles. Chromium draws in software, at most 60 frames a second,
and the dashboard lowers the number of pixels until a frame takes less than 1/31 s.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import naosprint_api
import numpy as np
import psutil
from naosim import robots
from naosim.fields import RCSSSERVERMJ as FIELD
from naosprint.matches.log import GameLog
from naosprint.matches.results import FRAME_S
from naosprint.programs import above_zero, integer, run_program

ROOT = Path(__file__).parents[2]
STATIC = Path(naosprint_api.__file__).parent / "static"
OPEN = """
const [field, view, done] = arguments;
(async () => {
  const { GameStage, figureOf } = await import("/js/game3d.js");
  const { GameLog } = await import("/js/game-log.js");
  const log = await GameLog.read(await (await fetch("/game.npz?" + performance.now())).arrayBuffer());
  const host = document.createElement("div");
  host.className = "stage game";
  document.body.replaceChildren(host);
  window.stage?.destroy();
  window.stage = new GameStage(host, log, await figureOf(log), field);
  window.stage.aim(view);
  done(null);
})();
"""
PLAY = """
const [seconds, done] = arguments;
let first = null;
let drawn = 0;
const script = [];
const tick = (now) => {
  first ??= now;
  const t = (now - first) / 1000;
  const began = performance.now();
  window.stage.show(Math.min(window.stage.log.frames - 1, t / 0.04));
  script.push(performance.now() - began);
  if (t < seconds) {
    drawn += 1;
    requestAnimationFrame(tick);
  } else {
    const { width, height } = window.stage.renderer.domElement;
    const { calls, triangles } = window.stage.renderer.info.render;
    done([drawn, drawn / t, script.sort((a, b) => a - b)[script.length >> 1], width, height, calls, triangles]);
  }
};
requestAnimationFrame(tick);
"""


class _Quiet(SimpleHTTPRequestHandler):
    log: Path

    def log_message(self, *_: object) -> None:
        """Print nothing."""

    def translate_path(self, path: str) -> str:
        """Return the file of an address; the game is not among those of the dashboard."""
        return str(self.log) if path.startswith("/game.npz") else super().translate_path(path)


def running_robots(count: int, seconds: float) -> GameLog:
    """Return a game in which robots run on circles around the ball's, half of them of each team."""
    t = FRAME_S * np.arange(round(seconds / FRAME_S) + 50)[:, None]
    k = np.arange(count)[None]
    heading = 0.35 * t + k * 2.4
    radius = 3.0 + 0.9 * k
    torso = np.stack([radius * np.sin(heading), -radius * np.cos(heading), 0.62 + 0.02 * np.sin(9 * t + k)], axis=2)
    quaternion = np.zeros((*heading.shape, 4))
    quaternion[..., 0], quaternion[..., 3] = np.cos(heading / 2), np.sin(heading / 2)
    robot = robots.get("t1")
    stride = 0.5 * np.sin(9 * t + k)[..., None] * np.array([joint.name.endswith("pitch") for joint in robot.joints])
    frames = len(t)
    return GameLog(
        teams=("blue", "orange"),
        robots=[(robot % 2, robot // 2 + 1) for robot in range(count)],
        sides=[0],
        half=np.zeros(frames, np.uint8),
        clock_s=t[:, 0].astype(np.float32),
        mode=np.full(frames, 3, np.uint8),
        score=np.zeros((frames, 2), np.uint8),
        ball_m=np.concatenate([4 * np.sin(t), 3 * np.cos(t), np.full_like(t, FIELD.ball_radius_m)], axis=1),
        torso_m=torso.astype(np.float32),
        quaternion=quaternion.astype(np.float32),
        joints_rad=(robot.nominal + stride).astype(np.float32),
        present=np.ones((frames, count), bool),
    )


def _cpu_s(pid: int) -> float:
    """Return the processor time of a process and all below it, seconds."""
    processes = [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]
    return sum(sum(each.cpu_times()[:2]) for each in processes)


def main() -> int:
    """Read the options, draw, and print a line for each number of robots and camera."""
    sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "e2e" / "dashboard")]
    from conftest import start_chromium

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=integer(), nargs="+", default=[2, 6, 14], help="robots on the field")
    parser.add_argument("--log", type=Path, help="log of a game to draw instead")
    parser.add_argument("--seconds", type=above_zero, default=5.0, help="seconds to draw")
    parser.add_argument("--size", type=integer(), nargs=2, default=[1440, 900], help="size of the window, pixels")
    parser.add_argument("--views", nargs="+", default=["ball", "above"], help="cameras: ball, above, field")
    parser.add_argument("--pictures", type=Path, help="folder for a picture of each")
    options = parser.parse_args()
    goal = {name: getattr(FIELD.goal, name) for name in ("width_m", "height_m", "depth_m", "post_radius_m")}
    names = ("length_m", "width_m", "line_width_m", "circle_radius_m", "penalty_spot_m", "ball_radius_m")
    field = {**{name: getattr(FIELD, name) for name in names}, "lines": FIELD.lines(), "goal": goal}
    with tempfile.TemporaryDirectory() as scratch:
        logs = [options.log] if options.log else [Path(scratch) / f"{count}.npz" for count in options.robots]
        if not options.log:
            for count, path in zip(options.robots, logs, strict=True):
                running_robots(count, options.seconds + 10.0).save(path)
        server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(STATIC)))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        driver = start_chromium(Path(scratch) / "profile", Path(scratch) / "downloads")
        try:
            driver.set_window_size(*options.size)
            driver.set_script_timeout(120 + options.seconds)
            driver.get(f"http://127.0.0.1:{server.server_port}/css/")
            driver.execute_script(
                "const l = document.createElement('link'); l.rel = 'stylesheet'; l.href = '/css/app.css';"
                "document.head.append(l);"
            )
            for path in logs:
                _Quiet.log = path
                count = len(GameLog.load(path).robots)
                for view in options.views:
                    driver.execute_async_script(OPEN, field, view)
                    driver.execute_async_script(PLAY, 6.0)  # until the number of pixels is found
                    before = _cpu_s(driver.service.process.pid)
                    drawn, rate, script_ms, width, height, calls, triangles = driver.execute_async_script(
                        PLAY, options.seconds
                    )
                    cpu_ms = 1000.0 * (_cpu_s(driver.service.process.pid) - before) / drawn
                    print(
                        f"{count} robots, {view}: {rate:.0f} frames a second of {width} x {height}; a frame takes "
                        f"{script_ms:.2f} ms of script, {cpu_ms:.0f} ms of CPU of all of Chromium, {calls} calls, "
                        f"{triangles:,} triangles"
                    )
                    sys.stdout.flush()
                    if options.pictures:
                        options.pictures.mkdir(parents=True, exist_ok=True)
                        (options.pictures / f"game-{count}-{view}.png").write_bytes(driver.get_screenshot_as_png())
        finally:
            driver.quit()
            server.shutdown()
    return 0


if __name__ == "__main__":
    run_program(main)
