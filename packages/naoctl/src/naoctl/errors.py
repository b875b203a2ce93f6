"""Errors of the command line and their exit codes."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit code of ``naoctl``."""

    OK = 0
    """Done; for ``watch``, ``logs --follow`` and ``submit --watch`` the job succeeded."""
    FAILURE = 1
    """Any error without a code of its own."""
    USAGE = 2
    """A flag, a file or a value is wrong: nothing was sent, or the service refused it as invalid."""
    UNREACHABLE = 3
    """The service does not answer."""
    DENIED = 4
    """The token is missing, wrong, expired or lacks the scope."""
    NOT_FOUND = 5
    """No such job, checkpoint, evaluation or group."""
    CONFLICT = 6
    """The job's state does not allow it, or the same key was used for another job."""
    CORRUPT = 7
    """A downloaded file does not have the SHA-256 the service promised."""
    STACK = 8
    """The service on this machine could not start or stop, or another one uses the data folder."""
    JOB_FAILED = 10
    """The followed job failed."""
    JOB_CANCELLED = 11
    """The followed job was cancelled."""
    JOB_PAUSED = 12
    """The followed job was paused: it has no result yet."""
    INTERRUPTED = 130
    """Interrupted with Ctrl-C."""


def plain(text: object, instead: str = "\N{REPLACEMENT CHARACTER}", *, keep: str = "\t") -> str:
    """Return text without control, format and separator characters, which control the terminal or hide text."""
    return "".join(c if c.isprintable() or c in keep else instead for c in str(text))


class CliError(Exception):
    """Error that ends the command: what is wrong, and how to correct it."""

    def __init__(self, message: str, *, fix: str | None = None, code: ExitCode = ExitCode.FAILURE) -> None:
        super().__init__(message)
        self.message = message
        self.fix = fix
        self.code = code

    def __str__(self) -> str:
        if not self.fix:
            return self.message
        return f"{self.message}{'' if self.message.endswith(('.', '?', '!')) else '.'} {self.fix}"


class InvalidInput(CliError):
    """Flag, file or value that is wrong; found before anything is sent."""

    def __init__(self, message: str, *, fix: str | None = None) -> None:
        super().__init__(message, fix=fix, code=ExitCode.USAGE)


class Unreachable(CliError):
    """Service that does not answer."""

    def __init__(self, url: str, reason: str) -> None:
        super().__init__(
            f"Nothing answers at {url} ({reason})",
            fix="Start the service with `naoctl up`, or name another one with --url or NAOCTL_URL.",
            code=ExitCode.UNREACHABLE,
        )


class StackError(CliError):
    """Service on this machine that cannot start, stop or be found."""

    def __init__(self, message: str, *, fix: str | None = None) -> None:
        super().__init__(message, fix=fix, code=ExitCode.STACK)
