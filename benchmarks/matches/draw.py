"""Frames per second at which a browser draws a game from above, with 2, 6 and 14 robots.

    python benchmarks/matches/draw.py --robots 2 6 14 --seconds 5

Starts a headless Chromium on the dashboard's own module `pitch.js` and its style. Every frame moves and turns all
robots and the ball; Chromium draws in software and at most 60 frames a second.
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
import psutil
from naosim.fields import RCSSSERVERMJ as FIELD

ROOT = Path(__file__).parents[2]
STATIC = Path(naosprint_api.__file__).parent / "static"
SCRIPT = """
const [robots, seconds, field, done] = arguments;
(async () => {
  const { Pitch } = await import("/js/pitch.js");
  const pitch = new Pitch(field, "A game");
  document.body.replaceChildren(pitch.element);
  const place = (k, t) => [k % 2, k >> 1, 20 * Math.sin(0.3 * t + k), 14 * Math.cos(0.2 * t + 2 * k), t + k, k === 3];
  const drawing = [];
  let first = null;
  let frames = 0;
  const tick = (now) => {
    first ??= now;
    const t = (now - first) / 1000;
    const began = performance.now();
    const players = Array.from({ length: robots }, (_, k) => place(k, t));
    pitch.show({ ball: [10 * Math.sin(t), 5 * Math.cos(t)], players });
    pitch.element.getBoundingClientRect();
    drawing.push(performance.now() - began);
    if (t < seconds) {
      frames += 1;
      requestAnimationFrame(tick);
    } else done([frames, frames / t, drawing.sort((a, b) => a - b)[drawing.length >> 1]]);
  };
  requestAnimationFrame(tick);
})();
"""


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Print nothing."""


def _cpu_s(pid: int) -> float:
    """Return the processor time of a process and all below it, seconds."""
    processes = [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]
    return sum(sum(each.cpu_times()[:2]) for each in processes)


def main() -> int:
    """Read the options, draw, and print a line for each number of robots."""
    sys.path.insert(0, str(ROOT / "tests" / "e2e" / "dashboard"))
    from conftest import start_chromium

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", default=[2, 6, 14], help="robots on the field")
    parser.add_argument("--seconds", type=float, default=5.0, help="seconds to draw")
    options = parser.parse_args()
    goal = {"width_m": FIELD.goal.width_m, "depth_m": FIELD.goal.depth_m}
    names = ("length_m", "width_m", "line_width_m", "circle_radius_m")
    field = {**{name: getattr(FIELD, name) for name in names}, "lines": FIELD.lines(), "goal": goal}
    with tempfile.TemporaryDirectory() as scratch:
        server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(STATIC)))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        driver = start_chromium(Path(scratch) / "profile", Path(scratch) / "downloads")
        try:
            driver.set_script_timeout(60 + options.seconds)
            driver.get(f"http://127.0.0.1:{server.server_port}/css/")
            driver.execute_script(
                "const l = document.createElement('link'); l.rel = 'stylesheet'; l.href = '/css/app.css';"
                "document.head.append(l);"
            )
            for robots in options.robots:
                before = _cpu_s(driver.service.process.pid)
                frames, rate, drawing_ms = driver.execute_async_script(SCRIPT, robots, options.seconds, field)
                cpu_ms = 1000.0 * (_cpu_s(driver.service.process.pid) - before) / frames
                print(
                    f"{robots} robots: {rate:.0f} frames a second; a frame takes {drawing_ms:.2f} ms of script and "
                    f"layout, {cpu_ms:.1f} ms of CPU of all of Chromium"
                )
        finally:
            driver.quit()
            server.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
