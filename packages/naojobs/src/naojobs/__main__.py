"""Administer the job service from a shell: `python -m naojobs migrate`, `python -m naojobs token create ...`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path

from naojobs.database import downgrade, make_engine, make_sessions, upgrade
from naojobs.errors import JobError
from naojobs.settings import ServiceSettings
from naojobs.tokens import Scope, create_token, list_tokens, revoke


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m naojobs", description="Administer the job service.")
    commands = parser.add_subparsers(dest="command", required=True)

    migrate = commands.add_parser("migrate", help="bring the database to a revision")
    migrate.add_argument("--revision", default="head", help="target revision (default: head)")
    migrate.add_argument("--down", action="store_true", help="go back to the revision instead of up to it")
    migrate.add_argument("--directory", type=Path, default=Path("migrations"), help="folder of the migrations")

    token = commands.add_parser("token", help="make, list and revoke tokens").add_subparsers(dest="verb", required=True)
    create = token.add_parser("create", help="make a token; its secret is shown once")
    create.add_argument("--owner", required=True, help="whose jobs it opens")
    create.add_argument("--name", default="", help="what it is for")
    create.add_argument("--scope", action="append", choices=list(Scope), required=True, help="may be given repeatedly")
    create.add_argument("--days", type=float, help="days until it expires (default: never)")
    token.add_parser("list", help="show all tokens, without their secrets")
    token.add_parser("revoke", help="make a token useless").add_argument("id")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; write its answer as JSON; return the exit code."""
    arguments = _parser().parse_args(argv)
    settings = ServiceSettings()  # type: ignore[call-arg]  # the environment fills it
    if arguments.command == "migrate":
        change = downgrade if arguments.down else upgrade
        change(settings.sqlalchemy_url, arguments.directory.resolve(), arguments.revision)
        return 0
    engine = make_engine(settings.sqlalchemy_url, pool_size=1)
    sessions = make_sessions(engine)
    try:
        if arguments.verb == "create":
            token_id, secret = create_token(
                sessions,
                name=arguments.name,
                owner=arguments.owner,
                scopes=[Scope(scope) for scope in arguments.scope],
                valid_for=timedelta(days=arguments.days) if arguments.days is not None else None,
            )
            answer: object = {"id": token_id, "token": secret}
        elif arguments.verb == "list":
            answer = [
                {
                    "id": token.id,
                    "name": token.name,
                    "owner": token.owner,
                    "scopes": token.scopes,
                    "created_at": token.created_at.isoformat(),
                    "expires_at": token.expires_at.isoformat() if token.expires_at else None,
                    "revoked_at": token.revoked_at.isoformat() if token.revoked_at else None,
                }
                for token in list_tokens(sessions)
            ]
        else:
            revoke(sessions, arguments.id)
            answer = {"id": arguments.id, "revoked": True}
    except (JobError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    finally:
        engine.dispose()
    sys.stdout.write(json.dumps(answer) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
