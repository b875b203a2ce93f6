"""What the API and the workers of the job service agree on.

The row in Postgres is the truth of a job; the Celery message is only a doorbell.

- `naojobs.settings`   one settings class, read from the environment
- `naojobs.states`     the states of a job and the allowed transitions
- `naojobs.models`     the SQLAlchemy models
- `naojobs.schemas`    what goes over HTTP
- `naojobs.lifecycle`  submit, claim, heartbeat, cancel, pause, resume, retry, re-queue: each one small transaction
- `naojobs.records`    metrics, logs, events, checkpoints and evaluations
- `naojobs.store`      the artifact store
- `naojobs.retention`  which checkpoints and files are kept
- `naojobs.archive`    all artifacts as one tar archive
- `naojobs.doorbell`   the Celery producer
- `naojobs.tokens`     bearer tokens, hashed at rest
- `naojobs.registry`   the workers and their heartbeats
"""

from __future__ import annotations

__version__ = "0.1.0"
