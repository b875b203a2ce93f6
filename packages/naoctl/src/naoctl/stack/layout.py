"""Files of a stack, all in one folder."""

from __future__ import annotations

import os
import re
import shlex
from dataclasses import dataclass
from pathlib import Path

import platformdirs
from naospec.files import private_folder

from naoctl.errors import StackError

_UNFIT = re.compile("[\x00-\x1f\x7f\ud800-\udfff]")
"""Control characters, and bytes that are not UTF-8."""


def default_data_dir() -> Path:
    """Return ``NAOCTL_DATA_DIR``, or the folder for this application's data in the user's own."""
    named = os.environ.get("NAOCTL_DATA_DIR")
    return Path(named).expanduser() if named else platformdirs.user_data_path("naosprint", appauthor=False)


@dataclass(frozen=True)
class Layout:
    """Paths of the stack's files below ``root``, an absolute path without symbolic links."""

    root: Path

    @classmethod
    def at(cls, folder: Path | None) -> Layout:
        """Return the layout of a folder, or of the default one."""
        return cls((folder or default_data_dir()).expanduser().resolve())

    @property
    def stop_command(self) -> str:
        """Command that stops the stack, with any ``NAOCTL_DATA_DIR`` in the shell."""
        usual = platformdirs.user_data_path("naosprint", appauthor=False).resolve()
        return "naoctl down" if self.root == usual else f"naoctl down --data-dir {shlex.quote(str(self.root))}"

    @property
    def lock(self) -> Path:
        """Lock of the supervisor, held while it runs."""
        return self.root / "stack.lock"

    @property
    def state(self) -> Path:
        """State of the current or last run: ``naoctl.stack.state.StackState``."""
        return self.root / "stack.json"

    @property
    def secrets(self) -> Path:
        """Passwords of database and broker, created at the first start; readable by the owner only."""
        return self.root / "secrets.json"

    @property
    def admin_token(self) -> Path:
        """Token of the administrator, created at the first start; readable by the owner only."""
        return self.root / "admin-token"

    @property
    def postgres(self) -> Path:
        """Postgres' data."""
        return self.root / "postgres"

    @property
    def broker(self) -> Path:
        """The broker's configuration and its append-only file."""
        return self.root / "broker"

    @property
    def artifacts(self) -> Path:
        """Checkpoints and evaluations."""
        return self.root / "artifacts"

    @property
    def work(self) -> Path:
        """Files of running attempts."""
        return self.root / "work"

    @property
    def logs(self) -> Path:
        """One log file per process."""
        return self.root / "logs"

    def log(self, name: str) -> Path:
        """Return the log file of one process."""
        return self.logs / f"{name}.log"

    def make(self) -> None:
        """Create the folders. A new folder is not accessible to other users.

        Raises:
            StackError: when it cannot be made or written, or its path has characters that settings cannot hold.
        """
        if _UNFIT.search(str(self.root)):
            raise StackError(
                f"The data folder {str(self.root)!r} has a line break, or bytes that are not UTF-8, in its path",
                fix="Name another with --data-dir.",
            )
        try:
            is_new = not self.root.exists()
            private_folder(self.root)
            if is_new:
                # Root's Postgres runs as another account, which must be able to pass; everything inside is closed.
                self.root.chmod(0o711 if os.geteuid() == 0 else 0o700)
            for folder in (self.artifacts, self.work, self.logs, self.broker):
                folder.mkdir(exist_ok=True, mode=0o700)
            probe = self.root / ".writable"
            probe.touch()
            probe.unlink()
        except OSError as error:
            raise StackError(
                f"Cannot write the data folder {self.root} ({error.strerror})", fix="Name another with --data-dir."
            ) from None
