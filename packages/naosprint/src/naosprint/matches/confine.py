"""Run one command with limits.

A file of its own that needs nothing but the standard library: `python -I -S confine.py OPTIONS COMMAND...`. The options
are JSON: cpu_s, memory_mb, reads, writes, port, report.

The kernel limits processor time, memory, the size of a file and the number of open files (`setrlimit`). With Landlock,
where the kernel has it, the command reads only the folders ``reads``, writes only those of ``writes``, and connects
with TCP to nothing but the server's port. Not limited are UDP and the number of processes. What is enforced is written
to the file ``report`` as a JSON list.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import struct
import sys

_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_PATH_BENEATH, _NET_PORT = 1, 2
_NO_NEW_PRIVILEGES = 38
_EXECUTE, _READ_FILE, _READ_FOLDER = 1, 4, 8
_FILES_BY_VERSION = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}
"""Number of access rights of files, by the version of Landlock; later versions have no more."""
_BIND_TCP, _CONNECT_TCP = 1, 2
NETWORK_VERSION = 4
"""First version of Landlock with rules for TCP."""
_FILE_BYTES, _OPEN_FILES = 256 << 20, 256


def limit_resources(cpu_s: int, memory_mb: int) -> list[str]:
    """Set limits of this process and all that it starts; return their names."""
    limits = {
        "cpu": (resource.RLIMIT_CPU, cpu_s),
        "memory": (resource.RLIMIT_AS, memory_mb << 20),
        "file size": (resource.RLIMIT_FSIZE, _FILE_BYTES),
        "open files": (resource.RLIMIT_NOFILE, _OPEN_FILES),
        "core dumps": (resource.RLIMIT_CORE, 0),
    }
    for number, value in limits.values():
        hard = resource.getrlimit(number)[1]
        most = value if hard == resource.RLIM_INFINITY else min(value, hard)
        resource.setrlimit(number, (most, most))
    return list(limits)


def landlock_version() -> int:
    """Return the version of the kernel's Landlock, less than 1 without one."""
    return int(ctypes.CDLL(None, use_errno=True).syscall(_CREATE_RULESET, None, 0, 1))


def limit_access(reads: list[str], writes: list[str], port: int) -> list[str]:
    """Restrict files and network of this process and all that it starts; return what the kernel enforces."""
    libc = ctypes.CDLL(None, use_errno=True)
    version = landlock_version()
    if version < 1:
        return []
    every = (1 << _FILES_BY_VERSION[min(version, 5)]) - 1
    network = (_BIND_TCP | _CONNECT_TCP) if version >= NETWORK_VERSION else 0
    attributes = struct.pack("QQ", every, network)[: 16 if network else 8]
    rules = libc.syscall(_CREATE_RULESET, attributes, len(attributes), 0)
    if rules < 0:
        return []
    reading = _EXECUTE | _READ_FILE | _READ_FOLDER
    folders = [(path, reading) for path in reads] + [(path, every) for path in writes]
    for path, rights in folders:
        try:
            fd = os.open(path, os.O_PATH | os.O_CLOEXEC)
        except OSError:
            continue
        # of the rights of folders, a file has none
        allowed = rights if os.path.isdir(path) else rights & (_EXECUTE | _READ_FILE | 2)
        libc.syscall(_ADD_RULE, rules, _PATH_BENEATH, struct.pack("=Qi", allowed, fd), 0)
        os.close(fd)
    if network:
        libc.syscall(_ADD_RULE, rules, _NET_PORT, struct.pack("QQ", _CONNECT_TCP, port), 0)
    if libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0) or libc.syscall(_RESTRICT_SELF, rules, 0):
        return []
    os.close(rules)
    return ["files", *(["TCP"] if network else [])]


def main() -> None:
    """Set the limits and become the command."""
    options, *command = sys.argv[1:]
    limits = json.loads(options)
    report = os.open(limits["report"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    enforced = limit_resources(limits["cpu_s"], limits["memory_mb"])
    enforced += limit_access(limits["reads"], limits["writes"], limits["port"])
    os.write(report, json.dumps(enforced).encode())
    os.close(report)
    os.execvp(command[0], command)  # noqa: S606 - the command is what this program is for


if __name__ == "__main__":
    main()
