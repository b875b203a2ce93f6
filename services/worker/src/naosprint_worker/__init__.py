"""Take a training job and see it through: claim, lease, heartbeat, cancel, pause, resume, evaluate.

The database row is the truth of a job. A broker message only says "look at this row now": losing or doubling one is
harmless. Training runs in a child process in a session of its own, so that it can be stopped as a group and can never
take the worker down.
"""

from __future__ import annotations

__version__ = "0.1.0"
