"""Take the pictures of the dashboard that the documentation shows, from a stack with an evaluated job.

`make demo` leaves such a stack behind; then `.venv/bin/python docs/make_pictures.py` writes docs/images. It needs
Chromium and its driver (`apt-get install chromium chromium-driver`), as the browser tests do.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
from PIL import Image

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "e2e" / "dashboard")]
from conftest import CHROMEDRIVER, CHROMIUM, Browser, start_chromium  # noqa: E402

VIEW_WIDTH = 1280  # CSS pixels of a screenshot
PICTURE_LIMIT = 300_000  # bytes
GIF_VIEW = (682, 1400)  # CSS pixels; leaves GIF_WIDTH to the replay itself, and all of it in sight
GIF_WIDTH = 640
GIF_LIMIT = 2_000_000  # bytes
GIF_SECONDS = 3
GIF_FRAME_S = 0.06  # browsers draw GIF frames shorter than 0.02 s slowly; a multiple of 0.01 s
GIF_COLOURS = 96


def main() -> None:
    """Read the command line, start the stack, take the pictures, stop the stack."""
    parser = argparse.ArgumentParser(description="Take the pictures of the dashboard that the documentation shows.")
    parser.add_argument(
        "data_dir",
        nargs="?",
        type=Path,
        default=Path.home() / ".local" / "share" / "naosprint-demo",
        help="data folder of a one-machine stack with an evaluated job (default: the one of `naoctl demo`)",
    )
    parser.add_argument("--job", help="id of the job (default: the newest one with a recorded episode)")
    arguments = parser.parse_args()
    if CHROMIUM is None or CHROMEDRIVER is None:
        parser.exit(1, "Chromium and its driver are needed: apt-get install chromium chromium-driver\n")
    if not (arguments.data_dir / "postgres").is_dir():
        parser.exit(1, f"{arguments.data_dir} is not a data folder of a stack: run `make demo` or name another\n")
    IMAGES.mkdir(exist_ok=True)
    with running_stack(arguments.data_dir) as url, tempfile.TemporaryDirectory() as scratch:
        token = (arguments.data_dir / "admin-token").read_text().strip()
        with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {token}"}, timeout=60) as client:
            job_id, replay = find_episode(client, arguments.job)
        driver = start_chromium(Path(scratch) / "profile", Path(scratch))
        try:
            browser = Browser(driver, url, Path(scratch))
            browser.size(VIEW_WIDTH, 900)
            browser.sign_in(token)
            take_pictures(browser, job_id, replay)
            take_film(browser, job_id, replay)
        finally:
            driver.quit()


@contextlib.contextmanager
def running_stack(data_dir: Path) -> Iterator[str]:
    """Start the one-machine stack of a data folder; yield its address; stop it."""
    naoctl = [sys.executable, "-m", "naoctl"]
    where = ["--data-dir", str(data_dir)]
    started = subprocess.run([*naoctl, "up", "--detach", "--json", *where], stdout=subprocess.PIPE)
    if started.returncode:
        raise SystemExit(started.returncode)  # naoctl has printed the reason to stderr
    try:
        yield json.loads(started.stdout)["url"]
    finally:
        subprocess.run([*naoctl, "down", *where], check=True, stdout=subprocess.DEVNULL)


def find_episode(client: httpx.Client, job_id: str | None) -> tuple[str, dict[str, Any]]:
    """Return a job's id and the newest episode that was recorded of it."""

    def get(path: str) -> Any:
        return client.get(path).raise_for_status().json()

    for candidate in [job_id] if job_id else [job["id"] for job in get("/jobs?state=succeeded")["items"]]:
        for evaluation in get(f"/jobs/{candidate}/evaluations")["items"]:
            for file in evaluation["files"]:
                if evaluation["state"] == "succeeded" and file["name"] == "replay.json":
                    return candidate, get(file["url"])
    raise SystemExit(
        "no job here has a recorded episode: submit one with an evaluation, and run this again when it is done"
    )


def full_stride(replay: dict[str, Any]) -> int:
    """Return the frame of the episode's middle third with the feet farthest apart in the running direction."""
    names = [body["name"] for body in replay["bodies"]]
    left, right = names.index("lfoot"), names.index("rfoot")
    frames = range(replay["frames"] // 3, 2 * replay["frames"] // 3)
    return max(frames, key=lambda f: abs(replay["position_m"][f][3 * left] - replay["position_m"][f][3 * right]))


def take_pictures(browser: Browser, job_id: str, replay: dict[str, Any]) -> None:
    """Write the screenshots."""
    pages = [
        ("curves-light", "light", 844, f"/jobs/{job_id}", ".chart canvas"),
        ("curves-dark", "dark", 844, f"/jobs/{job_id}", ".chart canvas"),
        ("evaluation", "light", 2000, f"/jobs/{job_id}/evaluation", "svg g[data-episode]"),
        ("replay", "light", 1000, f"/jobs/{job_id}/replay", ".stage canvas"),
    ]
    for name, theme, height, place, sign in pages:
        browser.size(VIEW_WIDTH, height)
        browser.open(place)
        browser.theme(theme)
        browser.find(sign)
        browser.until(lambda: not browser.all(".loading"), message=f"{place} never finished loading")
        if name == "replay":
            show_frame(browser, full_stride(replay))
        settle(browser)
        save_png(Image.open(io.BytesIO(browser.driver.get_screenshot_as_png())), IMAGES / f"{name}.png")


def take_film(browser: Browser, job_id: str, replay: dict[str, Any]) -> None:
    """Write the replay of some seconds of the episode at full speed, in real time."""
    browser.size(*GIF_VIEW)
    browser.open(f"/jobs/{job_id}/replay")
    browser.theme("light")
    stage = browser.find(".stage")
    browser.find(".stage canvas")
    browser.js("arguments[0].style.height = '340px'", stage)
    step = GIF_FRAME_S / replay["dt_s"]
    count = min(round(GIF_SECONDS / GIF_FRAME_S), int(replay["frames"] / step))
    first = max(0, min(round(1.0 / replay["dt_s"]), replay["frames"] - round(count * step)))
    pictures = []
    for i in range(count):
        show_frame(browser, first + round(i * step))
        settle(browser)
        pictures.append(Image.open(io.BytesIO(stage.screenshot_as_png)).convert("RGB"))
    save_gif([p.resize((GIF_WIDTH, round(p.height * GIF_WIDTH / p.width)), Image.Resampling.LANCZOS) for p in pictures])


def show_frame(browser: Browser, frame: int) -> None:
    """Stop the replay at a frame."""
    browser.set(".replay-bar input[type=range]", str(frame))


def settle(browser: Browser) -> None:
    """Wait until the latest change is drawn, in the intended typeface."""
    browser.module(
        "await document.fonts.ready; for (const _ of [1, 2, 3]) await new Promise((r) => requestAnimationFrame(r));"
    )


def save_png(picture: Image.Image, path: Path) -> None:
    """Save with at most PICTURE_LIMIT bytes: in true colour if that fits, else with 256 colours."""
    picture.convert("RGB").save(path, optimize=True)
    if path.stat().st_size > PICTURE_LIMIT:
        picture.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
    report(path, PICTURE_LIMIT)


def save_gif(pictures: list[Image.Image]) -> None:
    """Save an endless film with one palette for all frames, so that still areas need no bytes."""
    sample = Image.new("RGB", (pictures[0].width, sum(p.height for p in pictures[::8])))
    for i, picture in enumerate(pictures[::8]):
        sample.paste(picture, (0, i * picture.height))
    # The robot covers little of the picture; this method keeps its colours.
    palette = sample.quantize(GIF_COLOURS, method=Image.Quantize.MAXCOVERAGE)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    path = IMAGES / "replay.gif"
    frames[0].save(
        path, save_all=True, append_images=frames[1:], duration=round(GIF_FRAME_S * 1000), loop=0, optimize=True
    )
    report(path, GIF_LIMIT)


def report(path: Path, limit: int) -> None:
    """Print what was written; refuse files that would make the documentation slow."""
    size = path.stat().st_size
    with Image.open(path) as picture:
        sys.stdout.write(f"{path.relative_to(ROOT)}  {picture.width} x {picture.height}  {size / 1000:.0f} kB\n")
    if size > limit:
        raise SystemExit(f"{path.name} has {size:,} bytes, more than {limit:,}")


if __name__ == "__main__":
    main()
