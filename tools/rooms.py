"""Count the lines of each room of the project, at one commit or beside those of another.

    python tools/rooms.py            # the working tree's HEAD
    python tools/rooms.py f6ffcb7    # that commit and HEAD, side by side

Lines of Python, C++, JavaScript and CSS without generated and foreign ones; JSON and documents have rows of their own.
"""

from __future__ import annotations

import argparse
import subprocess
from pathlib import Path, PurePosixPath

from naosprint.programs import run_program

ROOT = Path(__file__).parents[1]
CODE = {".py", ".pyi", ".cpp", ".hpp", ".js", ".css"}
OTHER = {".json": "JSON", ".md": "documents"}
FOREIGN = ("vendor/", "package-lock.json", "_factor.hpp", "_topology.hpp")


def room_of(path: str) -> str:
    """Return the room of a file; empty for a file that is not counted."""
    if any(each in path for each in FOREIGN):
        return ""
    suffix, parts = PurePosixPath(path).suffix, path.split("/")
    if suffix in OTHER:
        return OTHER[suffix]
    if suffix not in CODE:
        return ""
    if parts[0] in ("packages", "services"):
        inner = parts[4] if "src" in parts[2:3] and len(parts) > 5 else "cpp" if parts[2] == "cpp" else ""
        return "/".join((*parts[:2], *([inner] if inner else [])))
    return "/".join(parts[: 2 if parts[0] in ("tests", "benchmarks") else 1])


def lines_of(commit: str) -> dict[str, int]:
    """Return the lines of each room at a commit."""
    found: dict[str, int] = {}
    # git counts a line for each that was added since the empty tree
    empty = git("hash-object", "-t", "tree", "/dev/null").strip()
    for row in git("diff", "--numstat", "--no-renames", empty, commit).splitlines():
        added, _, path = row.split("\t")
        room = room_of(path)
        if room and added != "-":
            found[room] = found.get(room, 0) + int(added)
    return found


def git(*arguments: str) -> str:
    """Return what git prints."""
    return subprocess.run(("git", *arguments), cwd=ROOT, check=True, capture_output=True, text=True).stdout


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commits", nargs="*", metavar="COMMIT", help="shown beside HEAD")
    commits = [*parser.parse_args().commits, "HEAD"]
    counts = [lines_of(commit) for commit in commits]
    rooms = sorted({room for count in counts for room in count})
    sums = {"all code": [sum(n for room, n in count.items() if room not in OTHER.values()) for count in counts]}
    rows = {room: [count.get(room, 0) for count in counts] for room in rooms} | sums
    width = max(map(len, rows))
    print("room".ljust(width), *(commit[:9].rjust(9) for commit in commits))
    for room, numbers in rows.items():
        print(room.ljust(width), *(f"{number:>9,}" for number in numbers))


if __name__ == "__main__":
    run_program(main)
