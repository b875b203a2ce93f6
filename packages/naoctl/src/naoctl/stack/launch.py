"""Become another program that cannot outlive the supervisor.

Run as a script (``python -I -S launch.py PARENT_PID SIGNAL ACCOUNT COMMAND...``) by the supervisor for every process of
the stack: give up root's rights if an account is named, ask the kernel for a signal when the parent dies, and replace
this process by the command. A script instead of ``preexec_fn``, which is unsafe once a process has threads.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import sys

# Linux: linux/prctl.h, linux/capability.h, linux/securebits.h
PR_SET_PDEATHSIG = 1
PR_SET_KEEPCAPS = 8
PR_SET_SECUREBITS = 28
SECBIT_NO_SETUID_FIXUP = 1 << 2
PR_CAP_AMBIENT = 47
PR_CAP_AMBIENT_RAISE = 2
CAPABILITY_VERSION_3 = 0x20080522
CAP_DAC_OVERRIDE = 1
CAP_DAC_READ_SEARCH = 2

SAME_ACCOUNT = "-"
"""The account field's value that keeps the present one."""


class _CapabilityHeader(ctypes.Structure):
    _fields_ = (("version", ctypes.c_uint32), ("pid", ctypes.c_int))


class _CapabilityData(ctypes.Structure):
    _fields_ = (("effective", ctypes.c_uint32), ("permitted", ctypes.c_uint32), ("inheritable", ctypes.c_uint32))


def drop_root(uid: int, gid: int, *, keep_search: bool) -> None:
    """Continue as another account for good.

    With ``keep_search`` the one right to pass through folders closed to that account stays (the capability
    DAC_READ_SEARCH, or DAC_OVERRIDE where the former was never granted), so that programs and data below root's own
    home folder can be reached without opening that folder to everybody.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    capability = _search_capability(libc) if keep_search else None
    if capability is not None:
        libc.prctl(PR_SET_KEEPCAPS, 1, 0, 0, 0)
        # Without it access(2), by which Postgres looks for its programs, takes no notice of the right that stays. Where
        # root may not set it, the programs have to lie where everybody can reach them.
        libc.prctl(PR_SET_SECUREBITS, SECBIT_NO_SETUID_FIXUP, 0, 0, 0)
    os.setgroups([])
    os.setresgid(gid, gid, gid)
    os.setresuid(uid, uid, uid)
    if capability is not None:
        mask = 1 << capability
        header = _CapabilityHeader(CAPABILITY_VERSION_3, 0)
        data = (_CapabilityData * 2)(_CapabilityData(mask, mask, mask), _CapabilityData(0, 0, 0))
        if libc.capset(ctypes.byref(header), data) != 0:
            raise OSError(ctypes.get_errno(), "capset")
        if libc.prctl(PR_CAP_AMBIENT, PR_CAP_AMBIENT_RAISE, capability, 0, 0) != 0:
            raise OSError(ctypes.get_errno(), "prctl(PR_CAP_AMBIENT_RAISE)")


def _search_capability(libc: ctypes.CDLL) -> int | None:
    header = _CapabilityHeader(CAPABILITY_VERSION_3, 0)
    data = (_CapabilityData * 2)()
    if libc.capget(ctypes.byref(header), data) != 0:
        return None
    permitted: int = data[0].permitted
    for capability in (CAP_DAC_READ_SEARCH, CAP_DAC_OVERRIDE):
        if permitted & (1 << capability):
            return capability
    return None


def die_with(parent_pid: int, death_signal: int) -> None:
    """Ask the kernel for a signal when the parent dies, and stop at once if it is gone already. Only Linux can."""
    if sys.platform != "linux":
        return
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_PDEATHSIG, death_signal, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    if os.getppid() != parent_pid:
        sys.exit(1)


def main(arguments: list[str]) -> None:
    """Do what the module says; ``ACCOUNT`` is ``-`` or ``UID:GID:KEEP_SEARCH``."""
    parent_pid, death_signal, account, *command = arguments
    # Everything that needs the interpreter's own library comes first: it may lie where the account cannot reach it.
    program = command[0] if os.path.isabs(command[0]) else shutil.which(command[0])
    if program is None:
        sys.exit(f"{command[0]}: no such program")
    if account != SAME_ACCOUNT:
        uid, gid, keep_search = (int(part) for part in account.split(":"))
        drop_root(uid, gid, keep_search=bool(keep_search))
    # After the change of account: the kernel forgets the request when credentials change.
    die_with(int(parent_pid), int(death_signal))
    # The interpreter ignores these two; most programs expect the default.
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    os.execv(program, command)  # noqa: S606 - to become that program is what this one is for


if __name__ == "__main__":
    main(sys.argv[1:])
