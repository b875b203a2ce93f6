"""Start a worker: ``python -m naosprint_worker``; all settings come from the environment.

The exit status of ``python -m naosprint_worker health`` is 0 if this host's worker is healthy.
"""

from __future__ import annotations

import argparse
import logging
import signal
import sys
from collections.abc import Sequence

from naojobs.settings import SETTINGS_ERRORS, settings_words
from naospec.proxies import exempt_loopback


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    exempt_loopback()
    parser = argparse.ArgumentParser(
        prog="naosprint-worker", description="Train sprint jobs. Settings come from the environment: NAOSPRINT_*."
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    commands.add_parser("run", help="claim jobs until SIGTERM (the default)")
    commands.add_parser("health", help="exit 0 if this host's worker has a recent heartbeat, else 1")
    arguments = parser.parse_args(argv)
    try:
        return _health() if arguments.command == "health" else _run()
    except SETTINGS_ERRORS as error:
        sys.stderr.write(settings_words(error))
        return 2


def _health() -> int:
    # A container runs this every few seconds, so it does not load what only a worker needs.
    from naojobs.settings import ServiceSettings

    from naosprint_worker.health import check

    return check(ServiceSettings())  # type: ignore[call-arg]  # the environment fills it


def _run() -> int:
    from naosprint_worker.application import make_application, serve
    from naosprint_worker.settings import WorkerSettings
    from naosprint_worker.worker import WorkLoop

    settings = WorkerSettings()  # type: ignore[call-arg]  # the environment fills it
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    for chatty in ("celery.worker.strategy", "celery.app.trace"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    worker = WorkLoop(settings)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))  # until Celery has its own handler
    try:
        worker.start()
        return serve(make_application(settings, worker), worker)
    finally:
        worker.close()


if __name__ == "__main__":
    sys.exit(main())
