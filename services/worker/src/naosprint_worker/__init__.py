"""Worker that claims trainings and evaluations and runs them: lease, heartbeat, cancel, pause, resume, settle.

The state of work is its row in the database, which a free worker polls; a broker message only makes it look at once,
and may be lost or duplicated. Training runs in a child process in a session of its own, so that it can be stopped as a
group and cannot crash the worker.
"""

from __future__ import annotations

__version__ = "0.2.0"
