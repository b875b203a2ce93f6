"""Draw the report of an evaluation for a child process."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from naojobs import records

from naosprint_worker.child_process import Services, StopRequestedError
from naosprint_worker.retry import describe

logger = logging.getLogger(__name__)


def add_report(
    services: Services,
    evaluation: Path,
    job_id: str,
    step: int,
    *,
    asked: str | None = None,
    warn: Callable[[str], None] = logger.warning,
) -> None:
    """Draw the report of the evaluation in ``evaluation`` into the same folder, if one is asked for.

    ``asked`` is film, pictures or off, and None for what the worker is set to. Without imageio-ffmpeg there is no film.

    Its learning curve is that of job ``job_id`` up to ``step``. A report that cannot be drawn is omitted and ``warn``
    is called with the reason; the metrics are stored without it.

    Raises:
        StopRequestedError: this process was asked to stop meanwhile.
    """
    wanted = asked or services.settings.worker_report
    if wanted == "off":
        return
    if wanted == "film" and find_spec("imageio_ffmpeg") is None:
        warn("the report has no film: this worker has no imageio-ffmpeg")
        wanted = "pictures"
    folder, metrics = services.workdir / "report", services.workdir / "metrics.jsonl"
    try:
        with services.stop.interruptible():
            from naosprint.analysis.report import write_report  # Matplotlib takes a while to load

            title = services.database(lambda: _write_metrics(services, job_id, step, metrics), "reading the metrics")
            write_report(folder, evaluation=evaluation, metrics=metrics, title=title, film=wanted == "film")
            for path in sorted(folder.iterdir()):
                path.replace(evaluation / path.name)
    except StopRequestedError:
        raise
    except Exception as error:
        logger.warning("drawing the report failed", exc_info=error)
        if not services.stop.requested():
            warn(f"the report could not be drawn, the metrics are stored without it: {describe(error)}")
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    if services.stop.requested():  # the interrupted call may have raised the request as an error of its own
        raise StopRequestedError


def _write_metrics(services: Services, job_id: str, step: int, path: Path) -> str:
    """Write a job's metrics up to ``step`` as JSON lines and return the job's name."""
    with path.open("w", encoding="utf-8") as file:
        for values in records.metrics_until(services.sessions, job_id, step):
            file.write(json.dumps(values) + "\n")
    return records.job_name(services.sessions, job_id)
