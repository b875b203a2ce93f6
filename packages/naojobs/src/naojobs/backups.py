"""Backups: while one is made, no file is deleted from the store.

A backup copies the database first and the store afterwards, which takes a while. Whatever its copy of the database
refers to must still be in the store then. Files that were to be deleted meanwhile are deleted by the next sweep.
"""

from __future__ import annotations

from datetime import timedelta

from sqlalchemy import delete, func, select

from naojobs.database import Sessions
from naojobs.errors import NotFoundError
from naojobs.models import Backup

#: Age of an unfinished backup at which it counts as broken off.
LONGEST = timedelta(days=1)


def begin(sessions: Sessions) -> int:
    """Announce a backup before it copies the database; return its id."""
    with sessions.begin() as session:
        backup = Backup()
        session.add(backup)
        session.flush()
        return backup.id


def finish(sessions: Sessions, backup_id: int) -> None:
    """Record that a backup is complete. Raises NotFoundError."""
    with sessions.begin() as session:
        backup = session.get(Backup, backup_id)
        if backup is None:
            raise NotFoundError(f"no backup {backup_id} was begun")
        backup.finished_at = func.now()


def abort(sessions: Sessions, backup_id: int) -> None:
    """Forget an unfinished backup."""
    with sessions.begin() as session:
        session.execute(delete(Backup).where(Backup.id == backup_id, Backup.finished_at.is_(None)))


def in_progress(sessions: Sessions) -> bool:
    """Return whether a backup is being made."""
    recent = Backup.started_at > func.now() - LONGEST
    with sessions() as session:
        return bool(session.scalar(select(select(Backup).where(Backup.finished_at.is_(None), recent).exists())))
