"""Roles of the database: one for each kind of process that connects to it, with the rights that it needs.

A superuser makes the roles (`python -m naojobs roles`); every migration grants their rights on the tables that it has
made. Without the roles, as on one machine, one user owns and uses everything.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Any

import psycopg
from psycopg import sql
from pydantic import Field, SecretStr

from naojobs.connections import bounds
from naojobs.settings import DatabaseSettings


class Role(StrEnum):
    """Role of the database."""

    OWNER = "naosprint_owner"
    """Owns the tables and migrates them."""
    API = "naosprint_api"
    """API and administration from a shell."""
    WORKER = "naosprint_worker"
    """Workers, their trainings and their health checks; owns the tables of the studies' sampler."""
    METRICS = "naosprint_metrics"
    """Reads the server's statistics, and no table."""
    BACKUP = "naosprint_backup"
    """Reads all tables but the sampler's. It has no password: it connects through the server's own socket only."""


RIGHTS: Mapping[str, Mapping[Role, str | tuple[str, ...]]] = {
    "alembic_version": {Role.API: "S", Role.WORKER: "S"},
    "backups": {Role.API: "SIUD", Role.WORKER: "S"},
    "checkpoints": {Role.API: "S", Role.WORKER: "SID"},
    "deliveries": {Role.API: "SIUD", Role.WORKER: "SI"},
    "evaluations": {Role.API: "SIU", Role.WORKER: "SIU"},
    "events": {Role.API: "SI", Role.WORKER: "SI"},
    "games": {Role.API: "S", Role.WORKER: "SI"},
    "generations": {Role.API: "S", Role.WORKER: "S"},
    "jobs": {Role.API: "SIUD", Role.WORKER: "SIU"},
    "lease_clocks": {Role.WORKER: "SU"},
    "logs": {Role.API: "S", Role.WORKER: "SI"},
    "match_events": {Role.API: "SI", Role.WORKER: "SI"},
    "matches": {Role.API: "SIUD", Role.WORKER: "SU"},
    "metrics": {Role.API: "S", Role.WORKER: "SIUD"},
    "policies": {Role.API: "SIUD", Role.WORKER: "S"},
    "policy_aliases": {Role.API: "SIUD", Role.WORKER: "S"},
    "policy_versions": {Role.API: "SID", Role.WORKER: "S"},
    "services": {Role.API: "S", Role.WORKER: "S"},
    "studies": {Role.API: "SIUD", Role.WORKER: "SU"},
    "teams": {Role.API: "SID", Role.WORKER: "S"},
    "tokens": {Role.API: "SIUD"},
    "trials": {Role.API: "SU", Role.WORKER: "SIU"},
    "usage": {Role.API: "S", Role.WORKER: "SIU"},
    # Workers write messages and see no key of signatures. Locking a row needs the right to update some column.
    "webhooks": {Role.API: "SIUD", Role.WORKER: ("SELECT (id, owner, events, disabled_at)", "UPDATE (created_at)")},
    "workers": {Role.API: "SU", Role.WORKER: "SIUD"},
}
"""Rights on each table: S, I, U and D stand for SELECT, INSERT, UPDATE and DELETE; rights on columns are in full. Rows
that a foreign key deletes with their job need none.
"""

_WORDS = {"S": "SELECT", "I": "INSERT", "U": "UPDATE", "D": "DELETE"}

_SAMPLER = "optuna"
"""Schema of the sampler's tables, which workers make and own. No backup contains it, since workers can define functions
in it; its tables are made again from `trials`.
"""

_FOREIGN = """
SELECT 'TABLE', c.relname FROM pg_class c
WHERE c.relnamespace = %(schema)s::regnamespace AND c.relowner <> %(owner)s::regrole AND c.relkind IN ('r', 'S')
  AND NOT EXISTS (SELECT FROM pg_depend d WHERE d.objid = c.oid AND d.deptype IN ('a', 'i') AND c.relkind = 'S')
UNION ALL
SELECT 'TYPE', t.typname FROM pg_type t
WHERE t.typnamespace = %(schema)s::regnamespace AND t.typowner <> %(owner)s::regrole AND t.typtype = 'e'
"""
"""Relations and types of a schema with another owner; a sequence of a column follows its table."""


class RoleSettings(DatabaseSettings):
    """Settings of `python -m naojobs roles`; `database_url` names a superuser."""

    owner_password: SecretStr = Field(min_length=1, description="Password of the role that migrates the database.")
    api_password: SecretStr = Field(min_length=1, description="Password of the API's role.")
    worker_password: SecretStr = Field(min_length=1, description="Password of the workers' role.")
    metrics_password: SecretStr = Field(min_length=1, description="Password of the role that reads statistics.")

    @property
    def passwords(self) -> dict[Role, str]:
        """Return the roles' passwords."""
        secrets = (self.owner_password, self.api_password, self.worker_password, self.metrics_password)
        roles = (Role.OWNER, Role.API, Role.WORKER, Role.METRICS)
        return {role: secret.get_secret_value() for role, secret in zip(roles, secrets, strict=True)}


def create_roles(url: str, passwords: Mapping[Role, str]) -> None:
    """Make the roles, set their passwords, and give the owner what the database has; may be repeated.

    Args:
        url: the database (postgresql://...), as a superuser.
        passwords: of all roles but the backup's. The server receives only what verifies them.

    Raises:
        psycopg.Error: the database refused, for example because the user is not a superuser.
    """
    # What the owner of the tables has put into a schema must not answer for what a superuser calls by name.
    options = "-c search_path=pg_catalog,pg_temp"
    with psycopg.connect(url, options=options, **bounds(url)) as connection:
        known = {name for (name,) in connection.execute("SELECT rolname FROM pg_roles")}
        for role in Role:
            name = sql.Identifier(role)
            if role not in known:
                connection.execute(sql.SQL("CREATE ROLE {}").format(name))
            connection.execute(
                sql.SQL(
                    "ALTER ROLE {} LOGIN NOSUPERUSER NOCREATEDB NOCREATEROLE NOREPLICATION NOBYPASSRLS PASSWORD {}"
                ).format(name, sql.Literal(_verifier(connection, role, passwords.get(role))))
            )
        database = sql.Identifier(connection.info.dbname)
        services = sql.SQL(", ").join(sql.Identifier(role) for role in Role)
        connection.execute("GRANT pg_monitor TO naosprint_metrics")
        # The right to read all data would include the hashes of passwords.
        for kind in ("TABLES", "SEQUENCES"):
            connection.execute(
                sql.SQL(
                    "ALTER DEFAULT PRIVILEGES FOR ROLE naosprint_owner GRANT SELECT ON {} TO naosprint_backup"
                ).format(sql.SQL(kind))
            )
        connection.execute(sql.SQL("REVOKE ALL ON DATABASE {} FROM PUBLIC").format(database))
        connection.execute(sql.SQL("GRANT CONNECT ON DATABASE {} TO {}").format(database, services))
        connection.execute(sql.SQL("GRANT CREATE ON DATABASE {} TO naosprint_owner").format(database))
        connection.execute("REVOKE ALL ON SCHEMA public FROM PUBLIC")
        for schema, owner in (("public", Role.OWNER), (_SAMPLER, Role.WORKER)):
            if _exists(connection, schema):
                _hand_over(connection, schema, owner)


def _verifier(connection: psycopg.Connection, role: Role, password: str | None) -> str | None:
    """Return what a server keeps of a password, so that the password is in no log of statements."""
    if password is None:
        return None
    verifier = connection.pgconn.encrypt_password(password.encode(), role.encode(), b"scram-sha-256")
    return verifier.decode()


def _hand_over(connection: psycopg.Connection, schema: str, owner: Role) -> None:
    """Make `owner` the owner of everything in a schema that an older version made as a superuser."""
    schema_name = sql.Identifier(schema)
    connection.execute(sql.SQL("ALTER SCHEMA {} OWNER TO naosprint_owner").format(schema_name))
    for kind, name in connection.execute(_FOREIGN, {"schema": schema, "owner": owner}).fetchall():
        statement = sql.SQL("ALTER {} {} OWNER TO {}")
        connection.execute(statement.format(sql.SQL(kind), sql.Identifier(schema, name), sql.Identifier(owner)))
    if schema != _SAMPLER:
        for objects in ("TABLES", "SEQUENCES"):
            statement = sql.SQL("GRANT SELECT ON ALL {} IN SCHEMA {} TO naosprint_backup")
            connection.execute(statement.format(sql.SQL(objects), schema_name))


def _exists(connection: psycopg.Connection, schema: str) -> bool:
    return connection.execute("SELECT to_regnamespace(%s)", (schema,)).fetchone() != (None,)


def grant_rights(connection: psycopg.Connection[Any]) -> None:
    """Grant the roles that exist their rights on the tables that exist, and revoke all others.

    Args:
        connection: to the database, as the owner of the tables; the caller commits.
    """
    known = {name for (name,) in connection.execute("SELECT rolname FROM pg_roles")}
    tables = {name for (name,) in connection.execute("SELECT tablename FROM pg_tables WHERE schemaname = 'public'")}
    for role in (Role.API, Role.WORKER):
        if role not in known:
            continue
        name = sql.Identifier(role)
        connection.execute(sql.SQL("GRANT USAGE ON SCHEMA public TO {}").format(name))
        connection.execute(sql.SQL("REVOKE ALL ON ALL TABLES IN SCHEMA public FROM {}").format(name))
        for table, rights in RIGHTS.items():
            if role in rights and table in tables:
                given = rights[role]
                words = sql.SQL(", ".join([_WORDS[letter] for letter in given] if isinstance(given, str) else given))
                connection.execute(
                    sql.SQL("GRANT {} ON TABLE {} TO {}").format(words, sql.Identifier("public", table), name)
                )
    if Role.WORKER in known and "metrics" in tables:
        connection.execute("GRANT USAGE ON SEQUENCE public.metrics_seq TO naosprint_worker")
    if Role.BACKUP in known:
        connection.execute("GRANT USAGE ON SCHEMA public TO naosprint_backup")
    if Role.WORKER in known and _exists(connection, _SAMPLER):
        connection.execute("GRANT USAGE, CREATE ON SCHEMA optuna TO naosprint_worker")
