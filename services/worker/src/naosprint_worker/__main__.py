"""Start a worker: ``python -m naosprint_worker``; everything else comes from the environment."""

from __future__ import annotations

import logging
import sys

from naojobs.doorbell import Doorbell
from pydantic import ValidationError

from naosprint_worker.application import make_application, register_tasks, serve
from naosprint_worker.settings import WorkerSettings
from naosprint_worker.worker import Worker


def main() -> int:
    """Run a worker until it is told to end; return its exit status."""
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    for chatty in ("celery.worker.strategy", "celery.app.trace"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    try:
        settings = WorkerSettings()  # type: ignore[call-arg]  # the environment fills it
    except ValidationError as error:
        for problem in error.errors(include_url=False, include_input=False):
            name = "_".join(str(part) for part in problem["loc"]).upper()
            sys.stderr.write(f"{'NAOSPRINT_' + name + ': ' if name else ''}{problem['msg']}\n")
        return 2
    app = make_application(settings)
    worker = Worker(settings, Doorbell(app))
    register_tasks(app, worker)
    worker.start()
    try:
        return serve(app, worker, settings)
    finally:
        worker.close()


if __name__ == "__main__":
    sys.exit(main())
