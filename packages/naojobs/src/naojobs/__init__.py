"""Jobs, evaluations and workers in the database, shared by API and workers.

The state of a piece of work is its row in Postgres; a Celery message only wakes up a worker.

- `naojobs.settings`       one settings class, read from the environment
- `naojobs.states`         the states of work and the allowed transitions
- `naojobs.models`         the SQLAlchemy models
- `naojobs.submission`     submission of jobs, groups and evaluations
- `naojobs.studies`        submission, look-up and end of studies
- `naojobs.requests`       what users request: cancel, pause, resume, retry, delete
- `naojobs.leases`         claims of workers, heartbeats, and who may write
- `naojobs.outcomes`       what workers report: begun, succeeded, lost, postponed; and what follows a lost worker
- `naojobs.changes`        changes of state and the events beside them
- `naojobs.capabilities`   requirements of work, capabilities of workers, and why work waits
- `naojobs.records`        metrics, logs, events, checkpoints and results of evaluations
- `naojobs.store`          the artifact store
- `naojobs.retention`      which checkpoints and files are kept
- `naojobs.archive`        all artifacts as one tar archive
- `naojobs.notifications`  wake-up messages through Celery
- `naojobs.tokens`         bearer tokens, hashed at rest
- `naojobs.registry`       the workers and their heartbeats
"""

from __future__ import annotations

__version__ = "0.2.0"
