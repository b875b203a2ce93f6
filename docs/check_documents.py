"""Run the commands of README.md in a fresh clone.

    python docs/check_documents.py            # about 10 minutes: install, up, every naoctl line, the curl example
    python docs/check_documents.py --all      # `make demo` and `make test` as well

Commands run as they stand, in order, with a home folder of their own, except that trainings of 3 million steps have
only STEPS: this checks that the commands work, not what a robot learns. Exits with 1 at the first command that fails.
`tests/e2e/docs` runs those of other documents, too, in the present environment.
"""

from __future__ import annotations

import argparse
import contextlib
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
STEPS = 65_536
"""Steps of the trainings that the documents wait for, instead of LONG."""
LONG = re.compile(r"\b(?:3000000|3M)\b")
LAST = re.compile(r"(checkpoint|export)-000003006464\b")
"""The last checkpoint of such a training."""
PLACEHOLDER = re.compile(r"\b(job|group|token|study)_…")
"""Ids in the documents, and those that the commands print."""
ID = re.compile(r"\b(job|group|token|study)_[0-9a-z]{26}\b")
BLOCK = re.compile(r"^```sh\n(.*?)^```", re.MULTILINE | re.DOTALL)
UP_TIMEOUT_S = 180
COMMAND_TIMEOUT_S = 1800


class CheckError(Exception):
    """Failure of a command of README.md."""


class Shell:
    """Runs commands in a folder, with the programs of an environment and a home of their own."""

    def __init__(self, folder: Path, home: Path, programs: Path) -> None:
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("NAOSPRINT_", "NAOCTL_"))}
        kept.pop("VIRTUAL_ENV", None)
        # Reuse pip's downloads.
        kept.setdefault("PIP_CACHE_DIR", str(Path.home() / ".cache" / "pip"))
        self.environment = {**kept, "HOME": str(home), "PATH": f"{programs}:{kept['PATH']}"}
        self.folder = folder
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
                cwd=self.folder,
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
                cwd=self.folder,
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
        for line in re.findall(r"(?:'[^']*'|\\\n|\s#\s[^\n]*|[^\n'])+", block):
            text = re.sub(r"\s+#\s.*$", "", line).strip()
            if text:
                found.append(text)
    return found


def typed(shell: Shell, lines: list[str], url: str) -> int:
    """Run commands against a service, with what earlier ones printed in place of ids; return their number."""
    seen: dict[str, str] = {}
    kept, count = "", 0

    def found(placeholder: re.Match[str]) -> str:
        return seen[placeholder[1]]

    for line in lines:
        command = LAST.sub(rf"\g<1>-{STEPS:012d}", LONG.sub(str(STEPS), line)).replace("http://127.0.0.1:8000", url)
        command = PLACEHOLDER.sub(found, command)
        if re.fullmatch(r"[A-Z_]+=.*", command):  # a variable for the commands after it
            kept += f"{command}; "
            continue
        answer = shell.run(kept + command if "$" in command else command)
        seen |= {match[1]: match[0] for match in ID.finditer(answer)}
        if "/stream" in command and "event: end" not in answer:
            raise CheckError(f"{command}\ndid not report the job's end:\n{answer[-2000:]}")
        count += 1
    return count


def split(lines: list[str]) -> tuple[list[str], str, list[str]]:
    """Return the commands of make, the one that starts the service, and the others; without activating a venv."""
    (stays,) = [line for line in lines if line.endswith("naoctl up")] or [""]
    made = [line for line in lines if line.startswith("make ")]
    return made, stays, [line for line in lines if line not in (*made, stays) and not line.startswith("source ")]


def check(shell: Shell, *, everything: bool) -> int:
    """Run every command of README.md; return their number."""
    made, stays, rest = split(commands((shell.folder / "README.md").read_text(encoding="utf-8")))
    shell.run("make install")
    for line in made if everything else ():
        shell.run(line)
    with shell.service(stays) as url:
        return 1 + (len(made) if everything else 0) + typed(shell, rest, url)


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
            count = check(Shell(clone, home, clone / ".venv" / "bin"), everything=arguments.all)
        except CheckError as error:
            sys.stderr.write(f"README.md: {error}\n")
            return 1
    sys.stdout.write(f"README.md: all {count} commands work\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
