"""Run the commands of README.md in a fresh clone.

    python docs/check_readme.py            # about 10 minutes: install, up, every naoctl line, the curl example
    python docs/check_readme.py --all      # `make demo` and `make test` as well

Commands run as they stand, in order, with a home folder of their own, except that trainings have only STEPS steps: this
checks that the commands work, not what a robot learns. Exits with 1 at the first command that fails.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
#: Steps of the trainings, instead of the millions that README.md names.
STEPS = 65_536
BLOCK = re.compile(r"^```sh\n(.*?)^```", re.MULTILINE | re.DOTALL)
LONG = re.compile(r"\b\d{7,}\b")
UP_TIMEOUT_S = 180
COMMAND_TIMEOUT_S = 1800


class CheckError(Exception):
    """Failure of a command of README.md."""


class Shell:
    """Runs commands in the clone, with a home of their own."""

    def __init__(self, clone: Path, home: Path) -> None:
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("NAOSPRINT_", "NAOCTL_"))}
        kept.pop("VIRTUAL_ENV", None)
        # Reuse pip's downloads.
        kept.setdefault("PIP_CACHE_DIR", str(Path.home() / ".cache" / "pip"))
        self.environment = {**kept, "HOME": str(home), "PATH": f"{clone / '.venv' / 'bin'}:{kept['PATH']}"}
        self.clone = clone
        self.home = home

    def run(self, command: str) -> str:
        """Run one command to its end; return what it printed.

        Raises:
            CheckError: it failed, or took too long.
        """
        sys.stdout.write(f"$ {command}\n")
        sys.stdout.flush()
        began = time.monotonic()
        try:
            done = subprocess.run(
                ["bash", "-euo", "pipefail", "-c", command],
                cwd=self.clone,
                env=self.environment,
                capture_output=True,
                text=True,
                timeout=COMMAND_TIMEOUT_S,
            )
        except subprocess.TimeoutExpired:
            raise CheckError(f"{command}\nhas not ended after {COMMAND_TIMEOUT_S} s") from None
        if done.returncode != 0:
            raise CheckError(f"{command}\nended with {done.returncode}:\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}")
        sys.stdout.write(f"  ok, {time.monotonic() - began:.1f} s\n")
        return done.stdout

    @contextlib.contextmanager
    def service(self, command: str) -> Iterator[str]:
        """Run `naoctl up` until it prints the dashboard's address; yield that; end it with Ctrl-C."""
        sys.stdout.write(f"$ {command}\n")
        log_path = self.home / "up.log"
        with log_path.open("wb") as log:
            process = subprocess.Popen(
                ["bash", "-c", f"exec {command}"],
                cwd=self.clone,
                env=self.environment,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        try:
            deadline = time.monotonic() + UP_TIMEOUT_S
            while (found := re.search(r"Dashboard\s+(http://\S+)", log_path.read_text(errors="replace"))) is None:
                if process.poll() is not None or time.monotonic() > deadline:
                    raise CheckError(f"{command}\ndid not come up:\n{log_path.read_text(errors='replace')[-3000:]}")
                time.sleep(0.2)
            sys.stdout.write(f"  up at {found[1]}\n")
            yield found[1]
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            try:
                code = process.wait(120)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                raise CheckError(f"{command}\ndid not end within two minutes of Ctrl-C") from None
        if code not in (0, 130):
            raise CheckError(f"{command}\nended with {code}:\n{log_path.read_text(errors='replace')[-3000:]}")
        left = subprocess.run(["pgrep", "-f", str(self.home)], capture_output=True, text=True).stdout.split()
        if left:
            raise CheckError(f"{command}\nleft processes behind: {', '.join(left)}")


def commands(readme: str) -> list[str]:
    """Return the commands of all shell blocks in order, continued lines joined, comments removed."""
    found = []
    for block in BLOCK.findall(readme):
        # quoted text may go over several lines
        for line in re.findall(r"(?:'[^']*'|\\\n|[^\n'])+", block):
            text = re.sub(r"\s+#\s.*$", "", line).strip()
            if text:
                found.append(text)
    return found


def check(shell: Shell, *, everything: bool) -> int:
    """Run every command; return their number."""
    lines = commands((shell.clone / "README.md").read_text(encoding="utf-8"))
    made = [line for line in lines if line.startswith("make ")]
    stays = next(line for line in lines if line.endswith("naoctl up"))
    rest = [line for line in lines if line not in (*made, stays) and not line.startswith("source ")]
    shell.run("make install")
    count = 1
    for line in made if everything else ():
        shell.run(line)
        count += 1
    with shell.service(stays) as url:
        job, kept = "", ""
        for line in rest:
            command = LONG.sub(str(STEPS), line).replace("http://127.0.0.1:8000", url)
            if re.fullmatch(r"[A-Z_]+=.*", command):  # a variable for the commands after it
                kept += f"{command}; "
                continue
            if "job_…" in command:
                command = command.replace("job_…", job)
            answer = shell.run(kept + command if "$" in command else command)
            if "-X POST" in command:
                job = str(json.loads(answer)["id"])
            if "/stream" in command and "event: end" not in answer:
                raise CheckError(f"{command}\ndid not report the job's end:\n{answer[-2000:]}")
            count += 1
    return count


def main() -> int:
    """Clone, check, clean up; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--all", action="store_true", help="run `make demo` and `make test` as well")
    parser.add_argument("--repository", default=str(ROOT), help="what to clone (default: this one)")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="readme-") as folder:
        clone, home = Path(folder) / "naosprint", Path(folder) / "home"
        home.mkdir()
        subprocess.run(
            ["git", "clone", "--quiet", "--depth", "1", f"file://{Path(arguments.repository).resolve()}", clone],
            check=True,
        )
        try:
            count = check(Shell(clone, home), everything=arguments.all)
        except CheckError as error:
            sys.stderr.write(f"README.md: {error}\n")
            return 1
    sys.stdout.write(f"README.md: all {count} commands work\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
