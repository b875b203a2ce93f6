"""Environment variables of the service's processes."""

from __future__ import annotations

from naoctl.errors import StackError
from naoctl.stack import ports
from naoctl.stack.broker import Broker
from naoctl.stack.layout import Layout
from naoctl.stack.passwords import read_secrets
from naoctl.stack.postgres import Postgres
from naoctl.stack.state import MARK, StackState


def service_environment(layout: Layout) -> dict[str, str]:
    """Return the variables that name the database, the broker and the artifacts of a stack.

    Raises:
        StackError: when no stack was ever started on the folder.
    """
    state = StackState.load(layout)
    if state is None or state.broker_port is None or state.api_port is None:
        raise StackError(f"No stack has been started on {layout.root}", fix="Start one with `naoctl up`.")
    passwords = read_secrets(layout)
    return {
        MARK: state.stack_id,
        "NAOSPRINT_MODE": "local",
        "NAOSPRINT_DATABASE_URL": Postgres(layout, passwords.postgres).url,
        "NAOSPRINT_BROKER_URL": Broker(layout, passwords.broker, state.broker_port).url,
        "NAOSPRINT_ARTIFACT_URL": layout.artifacts.as_uri(),
        "NAOSPRINT_API_HOST": ports.HOST,
        "NAOSPRINT_API_PORT": str(state.api_port),
        "NAOSPRINT_WORKER_DIR": str(layout.work),
        "PYTHONUNBUFFERED": "1",
        # paths in these variables are UTF-8 in every locale
        "PYTHONUTF8": "1",
    }
