"""Run one command with limits.

A file of its own that needs nothing but the standard library: `python -I -S confine.py OPTIONS COMMAND...`. The options
are JSON: cpu_s, memory_mb, reads, writes, port, report.

The kernel limits processor time, memory, the size of a file and the number of open files (`setrlimit`). With Landlock,
where the kernel has it, the command reads only the folders ``reads``, writes only those of ``writes``, connects with
TCP to nothing but the port ``port``, and signals only what it has started. A filter of system calls (seccomp) keeps it
in its process group, and from Unix sockets and what these rules do not see, `_CALLS`. Not limited are UDP, the number
of processes and their priority. What is enforced is written to the file ``report`` as a JSON list.
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
_NO_NEW_PRIVILEGES, _SECCOMP, _SECCOMP_FILTER = 38, 22, 2
_EXECUTE, _READ_FILE, _READ_FOLDER = 1, 4, 8
_FILES_BY_VERSION = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}
"""Number of access rights of files, by the version of Landlock; later versions have no more."""
_BIND_TCP, _CONNECT_TCP = 1, 2
_ABSTRACT_SOCKETS, _SIGNALS = 1, 2
_TCP_VERSION, _SCOPES_VERSION = 4, 6
NETWORK_VERSION = _SCOPES_VERSION
"""First version of Landlock that keeps an agent from the network and from others' processes (Linux 6.12)."""
_FILE_BYTES, _OPEN_FILES = 256 << 20, 256
_MACHINES = {"x86_64": (0, 0xC000003E), "aarch64": (1, 0xC00000B7)}
"""By machine its column of `_CALLS`, and what seccomp calls it."""
_WHOLE = 0xFFFFFFFF
_CALLS: tuple[tuple[tuple[int, ...], tuple[int, ...], int, int, tuple[int, ...]], ...] = (
    # socket: IPv4, IPv6 and netlink, with TCP or UDP; Landlock does not see MPTCP and SMC, nor most Unix sockets
    ((41,), (198,), 0, _WHOLE, (2, 10, 16)),
    ((41,), (198,), 2, _WHOLE, (0, 6, 17)),
    # socketpair: of streams; one of datagrams could send to any other socket
    ((53,), (199,), 1, 0xF, (1, 5)),
    # sendto and sendmmsg, sendmsg: without MSG_FASTOPEN, which connects and which Landlock does not see
    ((44, 307), (206, 269), 3, 0x20000000, (0,)),
    ((46,), (211,), 2, 0x20000000, (0,)),
    # prlimit64: of the process itself
    ((302,), (261,), 0, _WHOLE, (0,)),
    # io_uring_setup
    ((425,), (425,), 0, 0, ()),
    # listen: a socket that was not bound gets a port that Landlock does not see
    ((50,), (201,), 0, 0, ()),
    # setpgid and setsid: at the end of the match the process group is killed
    ((109, 112), (154, 157), 0, 0, ()),
    # modes, owners and attributes of files, also of those that it cannot open
    (
        (*range(90, 95), *range(188, 191), *range(197, 200), 260, 268, 452, 463, 466),
        (*range(5, 8), *range(14, 17), *range(52, 56), 452, 463, 466),
        *(0, 0, ()),
    ),
    # memory, semaphores and messages of System V
    ((*range(29, 32), *range(64, 72), 220), tuple(range(186, 198)), 0, 0, ()),
)
"""System calls that are refused unless an argument, masked, has one of some values.

Each has its numbers on both machines, the index of the argument, the mask and the values.
"""


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


def missing() -> str:
    """Return what this machine lacks to confine an agent; empty if nothing."""
    if landlock_version() < NETWORK_VERSION:
        return f"the kernel has no Landlock of version {NETWORK_VERSION}; use Linux 6.12 or newer with it"
    if not os.path.exists("/proc/sys/kernel/seccomp") or os.uname().machine not in _MACHINES:
        return f"there is no filter of system calls (seccomp) for this kernel; use one for {' or '.join(_MACHINES)}"
    return ""


def limit_access(reads: list[str], writes: list[str], port: int) -> list[str]:
    """Restrict files, network and signals of this process and all that it starts; return what the kernel enforces."""
    libc = ctypes.CDLL(None, use_errno=True)
    version = landlock_version()
    if version < 1:
        return []
    every = (1 << _FILES_BY_VERSION[min(version, 5)]) - 1
    network = (_BIND_TCP | _CONNECT_TCP) if version >= _TCP_VERSION else 0
    scopes = (_ABSTRACT_SOCKETS | _SIGNALS) if version >= _SCOPES_VERSION else 0
    attributes = struct.pack("QQQ", every, network, scopes)[: 24 if scopes else 16 if network else 8]
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
    return ["files", *(["TCP"] if network else []), *(["signals"] if scopes else [])]


def limit_calls() -> list[str]:
    """Refuse the system calls `_CALLS` of this process and all that it starts; return what the kernel enforces."""
    code = call_filter(os.uname().machine)
    libc, buffer = ctypes.CDLL(None, use_errno=True), ctypes.create_string_buffer(code, len(code) or 1)
    program = struct.pack("HP", len(code) // 8, ctypes.addressof(buffer))
    if not code or libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0) or libc.prctl(_SECCOMP, _SECCOMP_FILTER, program):
        return []
    return ["Unix sockets"]


def call_filter(machine: str) -> bytes:
    """Return the program (BPF) that refuses `_CALLS` with EPERM; empty for an unknown machine.

    A call of another architecture ends the process, since the same number means another call there.
    """
    if machine not in _MACHINES:
        return b""
    column, architecture = _MACHINES[machine]
    load, mask, equal, at_least, end = 0x20, 0x54, 0x15, 0x35, 0x06
    refuse, kill, allow = (end, 0, 0, 0x00050001), (end, 0, 0, 0x80000000), (end, 0, 0, 0x7FFF0000)
    number = (load, 0, 0, 0)
    # numbers from 2^30 are those of x32
    code = [(load, 0, 0, 4), (equal, 1, 0, architecture), kill, number, (at_least, 0, 1, 1 << 30), refuse]
    for *numbers, argument, bits, values in _CALLS:
        for call in numbers[column]:
            count = len(values)
            code += [(equal, 0, count + 4, call), (load, 0, 0, 16 + 8 * argument), (mask, 0, 0, bits)]
            code += [(equal, count - i, 0, value) for i, value in enumerate(values)]
            code += [refuse, number]
    return b"".join(struct.pack("HBBI", *each) for each in [*code, allow])


def main() -> None:
    """Set the limits and become the command."""
    options, *command = sys.argv[1:]
    limits = json.loads(options)
    report = os.open(limits["report"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    enforced = limit_resources(limits["cpu_s"], limits["memory_mb"])
    enforced += limit_access(limits["reads"], limits["writes"], limits["port"]) + limit_calls()
    os.write(report, json.dumps(enforced).encode())
    os.close(report)
    os.execvp(command[0], command)  # noqa: S606 - the command is what this program is for


if __name__ == "__main__":
    main()
