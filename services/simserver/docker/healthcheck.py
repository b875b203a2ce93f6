"""Succeed if the monitor port listens.

The port is looked up, not connected to, since a waiting server accepts no connections. Standard library only: it runs
in the server's image.
"""

from __future__ import annotations

import sys
from pathlib import Path


def main() -> int:
    """Return 0 if the server is healthy."""
    file = Path("/tmp/monitor-port")  # noqa: S108 - inside the container
    port = int(file.read_text(encoding="utf-8")) if file.exists() else 3200
    tables = [Path("/proc/net/tcp"), Path("/proc/net/tcp6")]
    lines = [line.split() for table in tables if table.exists() for line in table.read_text().splitlines()[1:]]
    listening = any(fields[3] == "0A" and int(fields[1].rsplit(":", 1)[1], 16) == port for fields in lines)
    return 0 if listening else 1


if __name__ == "__main__":
    sys.exit(main())
