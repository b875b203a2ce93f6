"""Backups: while one is made, no file is deleted from the store.

A backup copies the database first and the store afterwards, which takes a while. Whatever its copy of the database
refers to must still be in the store then. Files that were to be deleted meanwhile are deleted by the next sweep.

A restore takes only data from a dump, and only of the tables that the migrations make: roles with fewer rights than the
one that restores can define functions in a database that is dumped, and these would run.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import BinaryIO

import psycopg
from psycopg import sql
from sqlalchemy import delete, func, select, text, update

from naojobs.connections import bounds
from naojobs.database import Sessions, alembic_config, migration
from naojobs.errors import InvalidError, NotFoundError
from naojobs.models import Backup, Base, Generation
from naojobs.roles import grant_rights

LONGEST = timedelta(days=1)
"""Age of an unfinished backup at which it counts as broken off."""

_COPY = re.compile(r'COPY (\w+)\."?(\w+)"? \((["\w, ]+)\) FROM stdin;')
"""What `pg_restore --data-only` writes between the tables; each line is one of these."""
_SETVAL = re.compile(r"SELECT pg_catalog\.setval\('(\w+)\.(\w+)', (\d+), (true|false)\);")
_REST = re.compile(
    r"|--.*|SET \w+ = [^;]*;|SELECT pg_catalog\.set_config\('search_path', '', false\);|\\(un)?restrict \w+"
)
_END_OF_DATA, _COMPLETE = b"\\.\n", "-- PostgreSQL database dump complete"

_OWN = frozenset({"alembic_version", "generations", "lease_clocks"})
"""Tables whose rows a restored database has of its own."""

_OF_SERVICE = _OWN | {"services", "workers", "backups"}
"""Tables that have rows before anybody uses a service: migrations, workers and backups write them."""

_USERS_TOKENS = sql.SQL("""
to_jsonb(item) -> 'revoked_at' = 'null' AND coalesce((to_jsonb(item) ->> 'expires_at')::timestamptz > now(), true)
AND to_jsonb(item) -> 'scopes' ?| ARRAY['read', 'submit']
""")
"""Condition of users' valid tokens. An installation makes some of its own, to administer the service and to read its
metrics; those do not show that it is used.
"""

_OF_DUMPS = (psycopg.DataError, psycopg.IntegrityError, psycopg.errors.UndefinedTable)
"""Errors that a dump causes: rows that break a rule of their table, a sequence that does not exist."""

_FOREIGN_KEYS = """
SELECT conrelid::regclass::text, conname FROM pg_constraint
WHERE contype = 'f' AND connamespace = 'public'::regnamespace AND NOT condeferrable
"""
"""Constraints between tables. Jobs and checkpoints refer to each other, so no order of the tables would do."""


def restore(url: str, migrations: Path, source: BinaryIO) -> dict[str, int]:
    """Load a dump's data into a database that is not in use; return the number of rows of each table.

    The migrations make the tables, at the dump's revision and then at this version's. All of it is one transaction: a
    dump that cannot be used, or a restore that is broken off, leaves the tables and rows from before.

    Args:
        url: the database (postgresql+psycopg://...), as the owner of its tables.
        migrations: folder of the migrations.
        source: what `pg_restore --data-only --schema=public` writes of the dump.

    Raises:
        InvalidError: the database is in use, or the dump is incomplete, of another program or of a newer version.
    """
    lines, revision = _begin(url, migrations, source)
    with migration(url, migrations) as change:
        if _refuse_used(change.driver, url, migrations, lock=True):
            change.downgrade("base")
        change.upgrade(revision)
        try:
            counts = _load(change.driver, lines)
        except _OF_DUMPS as error:
            table, words = error.diag.table_name or lines.table, error.diag.message_primary
            raise InvalidError(f"the database refuses what the dump has of table {table} ({words})", "dump") from None
        change.upgrade()
        grant_rights(change.driver)
    return counts


def check_restore(url: str, migrations: Path, source: BinaryIO) -> None:
    """Check that a database is not in use and that a dump is whole, without a change to anything.

    Raises:
        InvalidError: as `restore` would; only that finds rows which the tables do not take.
    """
    lines, _ = _begin(url, migrations, source)
    with psycopg.connect(f"postgresql://{url.split('://', 1)[1]}", **bounds(url)) as connection:
        _refuse_used(connection, url, migrations)
    while lines.next_copy() is not None:
        for _row in lines.rows():
            pass


def _begin(url: str, migrations: Path, source: BinaryIO) -> tuple[_Lines, str]:
    """Return a dump behind its revision, and the revision. Raises InvalidError if this version does not know it."""
    lines = _Lines(source)
    if lines.next_copy() is None or lines.table != "alembic_version":
        raise InvalidError("the dump does not begin with its revision; write it with pg_restore --data-only", "dump")
    found = [row.decode("utf-8", "replace").strip() for row in lines.rows()]
    if len(found) != 1 or found[0] not in _revisions(url, migrations):
        names = ", ".join(map(repr, found)) or "none"
        raise InvalidError(f"the dump has revision {names}, which this version does not know", "dump")
    return lines, found[0]


def _revisions(url: str, migrations: Path) -> set[str]:
    from alembic.script import ScriptDirectory

    scripts = ScriptDirectory.from_config(alembic_config(url, migrations))
    return {script.revision for script in scripts.walk_revisions()}


def _refuse_used(connection: psycopg.Connection, url: str, migrations: Path, *, lock: bool = False) -> bool:
    """Return whether a database has tables.

    Args:
        connection: to the database.
        url: its address.
        migrations: folder of the migrations.
        lock: keep others from the tables until the end of the transaction, so that the answer stays true.

    Raises:
        InvalidError: they have rows that a restore would replace, or are those of a newer version.
    """
    of_public = "SELECT tablename FROM pg_tables WHERE schemaname = 'public'"
    made = {name for (name,) in connection.execute(of_public)}
    tables = {name: sql.Identifier("public", name) for name in sorted(made & set(Base.metadata.tables))}
    if lock and tables:
        connection.execute(sql.SQL("LOCK TABLE {}").format(sql.SQL(", ").join(tables.values())))
    if "alembic_version" in made:
        for (revision,) in connection.execute("SELECT version_num FROM public.alembic_version").fetchall():
            if revision not in _revisions(url, migrations):
                raise InvalidError(f"a newer version has migrated this database (revision {revision})", "database")
    used = []
    for name, table in tables.items():
        where = _USERS_TOKENS if name == "tokens" else sql.SQL("true")
        statement = sql.SQL("SELECT EXISTS (SELECT FROM {} AS item WHERE {})").format(table, where)
        if name not in _OF_SERVICE and connection.execute(statement).fetchone() == (True,):
            used.append(name)
    if used:
        raise InvalidError(
            f"this database is in use already: it has rows in {', '.join(used)}; restore into an empty one",
            "database",
        )
    return bool(tables)


def _load(connection: psycopg.Connection, lines: _Lines) -> dict[str, int]:
    keys = connection.execute(_FOREIGN_KEYS).fetchall()
    made = "SELECT table_name, column_name FROM information_schema.columns WHERE table_schema = 'public'"
    known: dict[str, set[str]] = {}
    for table, column in connection.execute(made):
        known.setdefault(table, set()).add(column)
    constrain = sql.SQL("ALTER TABLE {} ALTER CONSTRAINT {} {}")
    for table, name in keys:
        words = sql.SQL("DEFERRABLE INITIALLY DEFERRED")
        connection.execute(constrain.format(sql.SQL(table), sql.Identifier(name), words))
    counts: dict[str, int] = {}
    while (columns := lines.next_copy()) is not None:
        table = lines.table
        if table not in known or not known[table].issuperset(columns):
            more = ", ".join(sorted(set(columns) - known.get(table, set())))
            raise InvalidError(f"no migration of the dump's revision makes table {table} with {more}", "dump")
        if table in _OWN:
            for _ in lines.rows():
                pass
            continue
        if table in counts:
            raise InvalidError(f"the dump has table {table} twice", "dump")
        # Rows of the migrations, such as the key of the service: those of the dump replace them.
        connection.execute(sql.SQL("DELETE FROM {}").format(sql.Identifier("public", table)))
        names = sql.SQL(", ").join(map(sql.Identifier, columns))
        statement = sql.SQL("COPY {} ({}) FROM STDIN").format(sql.Identifier("public", table), names)
        with connection.cursor() as cursor:
            with cursor.copy(statement) as copy:
                for row in lines.rows():
                    copy.write(row)
            counts[table] = cursor.rowcount
    for name, value, called in lines.sequences:
        sequence = sql.Identifier("public", name).as_string(connection)
        connection.execute("SELECT setval(%s::regclass, %s, %s)", (sequence, value, called))
    # The backup that is restored was not finished when its dump was made.
    if "backups" in known:
        connection.execute("UPDATE public.backups SET finished_at = now() WHERE finished_at IS NULL")
    connection.execute("SET CONSTRAINTS ALL IMMEDIATE")
    for table, name in keys:
        connection.execute(constrain.format(sql.SQL(table), sql.Identifier(name), sql.SQL("NOT DEFERRABLE")))
    return counts


class _Lines:
    """Output of `pg_restore --data-only`, table by table; nothing of it is executed."""

    def __init__(self, source: BinaryIO) -> None:
        self._source = source
        self.table = ""
        self.sequences: list[tuple[str, int, bool]] = []

    def next_copy(self) -> list[str] | None:
        """Go to the next table's rows; return its columns, or nothing at the end. Raises InvalidError."""
        complete = False
        for raw in self._source:
            line = raw.decode("utf-8", "replace").rstrip("\n")
            if (match := _COPY.fullmatch(line)) and match[1] == "public":
                self.table = match[2]
                return [name.strip('"') for name in match[3].split(", ")]
            if (match := _SETVAL.fullmatch(line)) and match[1] == "public":
                self.sequences.append((match[2], int(match[3]), match[4] == "true"))
            elif line == _COMPLETE:
                complete = True
            elif not _REST.fullmatch(line):
                raise InvalidError(
                    f"the dump has more than the data of schema public ({line[:60]!r}); "
                    "write it with pg_restore --data-only --schema=public",
                    "dump",
                )
        if not complete:
            raise InvalidError("the dump is cut off", "dump")
        return None

    def rows(self) -> Iterator[bytes]:
        """Return the rows of the table as lines. Raises InvalidError."""
        for raw in self._source:
            if raw == _END_OF_DATA:
                return
            yield raw
        raise InvalidError(f"the dump is cut off in table {self.table}", "dump")


def begin(sessions: Sessions) -> int:
    """Announce a backup before it copies the database; return its id."""
    with sessions.begin() as session:
        backup = Backup()
        session.add(backup)
        session.flush()
        return backup.id


def finish(sessions: Sessions, backup_id: int) -> None:
    """Record that a backup is complete. Raises NotFoundError."""
    with sessions.begin() as session:
        backup = session.get(Backup, backup_id)
        if backup is None:
            raise NotFoundError(f"no backup {backup_id} was begun")
        backup.finished_at = func.now()


def abort(sessions: Sessions, backup_id: int) -> None:
    """Forget an unfinished backup."""
    with sessions.begin() as session:
        session.execute(delete(Backup).where(Backup.id == backup_id, Backup.finished_at.is_(None)))


def renew_generation(sessions: Sessions) -> None:
    """Give the database another generation: no attempt from before can write, and its work is queued again."""
    with sessions.begin() as session:
        session.execute(update(Generation).values(key=text("gen_random_uuid()::text")))


def in_progress(sessions: Sessions) -> bool:
    """Return whether a backup is being made."""
    recent = Backup.started_at > func.now() - LONGEST
    with sessions() as session:
        return bool(session.scalar(select(select(Backup).where(Backup.finished_at.is_(None), recent).exists())))
