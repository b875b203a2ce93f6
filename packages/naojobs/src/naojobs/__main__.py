"""Administer the job service from a shell: `python -m naojobs migrate`, `... token create`, `... artifacts export`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from datetime import timedelta
from pathlib import Path

import psycopg
from naospec.arguments import ArgumentParser
from naospec.files import replacing
from sqlalchemy.exc import DBAPIError, OperationalError, ProgrammingError

from naojobs import backups
from naojobs.archive import export_artifacts, import_artifacts, verify_artifacts
from naojobs.database import Sessions, downgrade, make_engine, make_sessions, upgrade
from naojobs.errors import JobError, NotFoundError
from naojobs.retention import DEFAULT_AGE_S, adopt, find_orphans, sweep
from naojobs.roles import RoleSettings, create_roles
from naojobs.settings import SETTINGS_ERRORS, DatabaseSettings, ServiceSettings, settings_words
from naojobs.store import ArtifactStore, StoreError
from naojobs.tokens import Scope, create_token, list_tokens, revoke, verify
from naojobs.upgrades import check_upgrade

STORE_PATIENCE_S = 120.0
"""Seconds for which a command repeats a request that the store refuses; a backup takes hours."""


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(prog="python -m naojobs", description="Administer the job service.")
    commands = parser.add_subparsers(dest="command", required=True)

    migrate = commands.add_parser("migrate", help="migrate the database to a revision")
    migrate.add_argument("--revision", default="head", help="target revision (default: head)")
    migrate.add_argument("--down", action="store_true", help="downgrade to the revision")
    migrate.add_argument("--force", action="store_true", help="migrate even if open work cannot be read afterwards")
    migrate.add_argument("--directory", type=Path, default=Path("migrations"), help="folder of the migrations")

    restore = commands.add_parser(
        "restore", help="load what `pg_restore --data-only --schema=public` writes into a database that is not in use"
    )
    restore.add_argument("--check", action="store_true", help="only check the dump and the database")
    restore.add_argument("--directory", type=Path, default=Path("migrations"), help="folder of the migrations")

    commands.add_parser("roles", help="make the database's roles with least rights; needs a superuser")

    token = commands.add_parser("token", help="make, list and revoke tokens").add_subparsers(dest="verb", required=True)
    create = token.add_parser("create", help="make a token; its secret is shown once")
    create.add_argument("--owner", required=True, help="user whose jobs it gives access to")
    create.add_argument("--name", type=str, default="", help="description of its purpose")
    create.add_argument("--scope", action="append", choices=list(Scope), required=True, help="may be given repeatedly")
    create.add_argument("--days", type=float, help="days until it expires (default: never)")
    token.add_parser("list", help="show all tokens, without their secrets")
    token.add_parser("verify", help="check that the token on standard input is valid")
    token.add_parser("revoke", help="revoke a token").add_argument("id")

    artifacts = commands.add_parser("artifacts", help="export, import and clean up artifacts")
    verbs = artifacts.add_subparsers(dest="verb", required=True)
    verbs.add_parser("export", help="write all artifacts to a tar archive").add_argument(
        "file", nargs="?", type=Path, help="the archive (default: standard output)"
    )
    verbs.add_parser("import", help="verify the artifacts of an archive and put them into the store").add_argument(
        "file", nargs="?", type=Path, help="the archive (default: standard input)"
    )
    verbs.add_parser("verify", help="check an archive against its manifests").add_argument(
        "file", nargs="?", type=Path, help="the archive (default: standard input)"
    )
    sweep = verbs.add_parser("sweep", help="delete files that no job refers to")
    sweep.add_argument("--hours", type=float, default=DEFAULT_AGE_S / 3600, help="only files this old (default: 24)")
    sweep.add_argument("--dry-run", action="store_true", help="only list the files")

    verbs.add_parser("adopt", help="make the store this service's, also if another one has used it")

    backup = commands.add_parser("backup", help="announce a backup: while one is made, no file is deleted")
    backups_verbs = backup.add_subparsers(dest="verb", required=True)
    backups_verbs.add_parser("begin", help="before the database is copied; prints the id")
    backups_verbs.add_parser(
        "restored",
        help="after the database's files were restored: queue running work again and fence its workers off",
    )
    for verb, text in (("finish", "record that it is complete"), ("abort", "forget it")):
        backups_verbs.add_parser(verb, help=text).add_argument("id", type=int)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; write its answer as JSON; return the exit code."""
    arguments = _parser().parse_args(argv)
    kind = {"roles": RoleSettings, "artifacts": ServiceSettings}.get(arguments.command, DatabaseSettings)
    try:
        settings = kind()
    except SETTINGS_ERRORS as error:
        sys.stderr.write(settings_words(error))
        return 2
    try:
        return _run(arguments, settings)
    except (JobError, StoreError, OSError, OverflowError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
    except (OperationalError, ProgrammingError, psycopg.OperationalError, psycopg.ProgrammingError) as error:
        # It does not answer, or lacks a table or a right: a traceback would hide that. Other errors are defects.
        cause = error.orig if isinstance(error, DBAPIError) else error
        sys.stderr.write(f"the database failed: {' '.join(str(cause).split())}\n")
    return 1


def _run(arguments: argparse.Namespace, settings: RoleSettings | DatabaseSettings) -> int:
    """Run a command; return the exit code."""
    if isinstance(settings, RoleSettings):
        create_roles(settings.libpq_url, settings.passwords)
        return 0
    if arguments.command == "migrate":
        migrations = arguments.directory.resolve()
        check_upgrade(settings.sqlalchemy_url, migrations, force=arguments.force or arguments.down)
        change = downgrade if arguments.down else upgrade
        change(settings.sqlalchemy_url, migrations, arguments.revision)
        return 0
    if arguments.command == "restore":
        migrations = arguments.directory.resolve()
        if arguments.check:
            backups.check_restore(settings.sqlalchemy_url, migrations, sys.stdin.buffer)
            return 0
        counts = backups.restore(settings.sqlalchemy_url, migrations, sys.stdin.buffer)
        sys.stdout.write(json.dumps({"rows": counts}) + "\n")
        return 0
    engine = make_engine(settings.sqlalchemy_url, pool_size=1)
    try:
        if isinstance(settings, ServiceSettings):
            store = ArtifactStore.from_settings(settings, patience_s=STORE_PATIENCE_S)
            answer = _artifacts(arguments, make_sessions(engine), store)
        elif arguments.command == "backup":
            answer = _backup(arguments, make_sessions(engine))
        else:
            answer = _token(arguments, make_sessions(engine))
    finally:
        engine.dispose()
    # Nothing else may be written to standard output if the archive is.
    stream = sys.stderr if arguments.verb == "export" and arguments.file is None else sys.stdout
    stream.write(json.dumps(answer, default=lambda time: time.isoformat()) + "\n")
    return 0


def _token(arguments: argparse.Namespace, sessions: Sessions) -> object:
    if arguments.verb == "create":
        if arguments.days is not None and not arguments.days > 0:
            raise ValueError("days: give more than 0")
        token_id, secret = create_token(
            sessions,
            name=arguments.name,
            owner=arguments.owner,
            scopes=[Scope(scope) for scope in arguments.scope],
            valid_for=timedelta(days=arguments.days) if arguments.days is not None else None,
        )
        return {"id": token_id, "token": secret}
    if arguments.verb == "list":
        shown = ("id", "name", "owner", "scopes", "created_at", "expires_at", "revoked_at")
        return [{name: getattr(token, name) for name in shown} for token in list_tokens(sessions)]
    if arguments.verb == "verify":
        principal = verify(sessions, sys.stdin.readline().strip())
        if principal is None:
            raise NotFoundError("the token is unknown, expired or revoked")
        return {"id": principal.token_id, "owner": principal.owner, "scopes": sorted(principal.scopes)}
    revoke(sessions, arguments.id)
    return {"id": arguments.id, "revoked": True}


def _backup(arguments: argparse.Namespace, sessions: Sessions) -> object:
    if arguments.verb == "begin":
        return backups.begin(sessions)
    if arguments.verb == "restored":
        backups.renew_generation(sessions)
        return {"generation": "renewed"}
    change = backups.finish if arguments.verb == "finish" else backups.abort
    change(sessions, arguments.id)
    return {"id": arguments.id}


def _artifacts(arguments: argparse.Namespace, sessions: Sessions, store: ArtifactStore) -> object:
    if arguments.verb == "export":
        if arguments.file is None:
            return {"files": export_artifacts(store, sys.stdout.buffer)}
        with replacing(arguments.file) as target:
            count = export_artifacts(store, target)
        return {"files": count, "archive": str(arguments.file)}
    if arguments.verb == "verify":
        with arguments.file.open("rb") if arguments.file is not None else nullcontext(sys.stdin.buffer) as source:
            return {"files": verify_artifacts(source)}
    if arguments.verb == "import":
        with arguments.file.open("rb") if arguments.file is not None else nullcontext(sys.stdin.buffer) as source:
            return {"files": import_artifacts(store, source)}
    if arguments.verb == "adopt":
        return {"since": adopt(sessions, store, force=True)}
    age_s = arguments.hours * 3600
    found = find_orphans(sessions, store, age_s=age_s) if arguments.dry_run else sweep(sessions, store, age_s=age_s)
    return {"deleted": not arguments.dry_run, "prefixes": list(found)}


if __name__ == "__main__":
    raise SystemExit(main())
