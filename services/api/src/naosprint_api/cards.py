"""Cards of policies: bundled ones from their files, versions of registered ones from the database."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cache
from typing import Any

import naopolicies
from naojobs.database import Sessions
from naojobs.errors import NotFoundError
from naojobs.models import Checkpoint, PolicyRecord, PolicyVersion
from naojobs.policies import aliases_of
from naojobs.promotion import requirements_of
from naojobs.store import StoreManifest
from naospec import plugins
from sqlalchemy import ColumnElement, func, select
from sqlalchemy.orm import Session

from naosprint_api.results import summaries_of
from naosprint_api.schemas.common import FilePublic
from naosprint_api.schemas.policies import PolicyCard, PolicyDetails, PolicyPage
from naosprint_api.views import files_view

BUNDLED_FILES = (naopolicies.CHECKPOINT, naopolicies.WEIGHTS)
"""Files of a bundled policy that make it a checkpoint."""

_SUMMARY = ("episodes", "results", "headline", "tables", "evaluation")


@cache
def bundled_card(name: str) -> PolicyCard:
    """Return the card of a bundled policy."""
    entry = {
        "reference": name,
        "owner": None,
        "version": 1,
        "aliases": [],
        "created_at": None,
        "job_id": None,
        "checkpoint_id": None,
        "evaluation_id": None,
        "spec_sha256": naopolicies.checkpoint(name)["spec_sha256"],
        "parent_policy": None,
    }
    return PolicyCard.model_validate({**naopolicies.card(name), **entry})


@cache
def bundled_files(name: str) -> list[FilePublic]:
    """Return the files of a bundled policy with their addresses."""
    content = {file: (naopolicies.folder(name) / file).read_bytes() for file in BUNDLED_FILES}
    return [
        FilePublic(
            name=file,
            size=len(data),
            sha256=hashlib.sha256(data).hexdigest(),
            url=f"/policies/{name}/files/{file}",
        )
        for file, data in content.items()
    ]


def bundled_details(name: str) -> PolicyDetails:
    """Return a bundled policy with its specification and its files."""
    return PolicyDetails(**dict(bundled_card(name)), spec=naopolicies.spec(name), files=bundled_files(name))


def policy_page(sessions: Sessions, owned: ColumnElement[bool], *, limit: int, cursor: str | None) -> PolicyPage:
    """Return up to `limit` policies after `cursor`: bundled ones by name, then registered ones that meet `owned`.

    Of a registered policy this is its newest version; the oldest policy comes first. A cursor is the name of a bundled
    policy or the id of a registered one, which no name can be: it has an underscore.
    """
    after = cursor if cursor is not None and "_" in cursor else ""
    names = [] if after else [name for name in naopolicies.names() if name > (cursor or "")]
    found = [(name, bundled_card(name)) for name in names]
    if len(found) <= limit:
        found += _newest_cards(sessions, owned, limit=limit + 1 - len(found), after=after)
    return PolicyPage(
        items=[card for _, card in found[:limit]],
        next_cursor=found[limit - 1][0] if len(found) > limit else None,
    )


def _newest_cards(
    sessions: Sessions, owned: ColumnElement[bool], *, limit: int, after: str
) -> list[tuple[str, PolicyCard]]:
    """Return the id and the newest version of up to `limit` registered policies that meet `owned`, oldest first."""
    newest = (
        select(PolicyVersion.policy_id, func.max(PolicyVersion.number).label("number"))
        .group_by(PolicyVersion.policy_id)
        .subquery()
    )
    statement = (
        select(PolicyRecord, PolicyVersion)
        .join(PolicyVersion, PolicyVersion.policy_id == PolicyRecord.id)
        .join(newest, (newest.c.policy_id == PolicyVersion.policy_id) & (newest.c.number == PolicyVersion.number))
        .where(owned, PolicyRecord.id > after)
        .order_by(PolicyRecord.id)
        .limit(limit)
    )
    with sessions.begin() as session:
        rows = [(policy, version) for policy, version in session.execute(statement)]
        return [(policy.id, card) for (policy, _), card in zip(rows, _cards(session, rows), strict=True)]


def version_page(sessions: Sessions, policy: PolicyRecord, *, limit: int, before: int | None) -> PolicyPage:
    """Return up to `limit` versions of a registered policy, those before a number if given, newest first."""
    statement = select(PolicyVersion).where(PolicyVersion.policy_id == policy.id).limit(limit + 1)
    if before is not None:
        statement = statement.where(PolicyVersion.number < before)
    with sessions.begin() as session:
        versions = session.scalars(statement.order_by(PolicyVersion.number.desc())).all()
        page = _cards(session, [(policy, version) for version in versions[:limit]])
    return PolicyPage(items=page, next_cursor=str(page[-1].version) if len(versions) > limit else None)


def version_details(sessions: Sessions, policy: PolicyRecord, version: PolicyVersion) -> PolicyDetails:
    """Return a version of a registered policy with its specification and its files. Raises NotFoundError."""
    with sessions.begin() as session:
        (card,) = _cards(session, [(policy, version)])
        checkpoint = session.get(Checkpoint, version.checkpoint_id)
    if checkpoint is None:  # the version was deleted meanwhile, and then its job
        raise NotFoundError(f"policy {policy.name} has no version {version.number}")
    files = files_view(StoreManifest.model_validate(checkpoint.manifest), f"/checkpoints/{checkpoint.id}")
    required = {alias: requirements_of(policy, alias) for alias in policy.requirements}
    return PolicyDetails(**dict(card), spec=version.spec, files=files, requirements=required)


def _cards(session: Session, rows: Sequence[tuple[PolicyRecord, PolicyVersion]]) -> list[PolicyCard]:
    aliases = aliases_of(session, list({policy.id for policy, _ in rows}))
    evaluations = summaries_of(session, [version.checkpoint_id for _, version in rows])
    cards = []
    for policy, version in rows:
        own = version.lineage[-1]
        evaluation = evaluations.get(version.checkpoint_id)
        none: dict[str, Any] = {"episodes": 0, "results": [], "headline": [], "tables": [], "evaluation": None}
        summary = none if evaluation is None else {**none, **_part(evaluation.summary or {})}
        held = aliases.get(policy.id, {})
        cards.append(
            PolicyCard(
                name=policy.name,
                reference=f"{policy.name}@{version.number}",
                owner=policy.owner,
                version=version.number,
                aliases=[alias for alias, number in held.items() if number == version.number],
                created_at=version.created_at,
                job_id=own["job_id"],
                checkpoint_id=version.checkpoint_id,
                evaluation_id=evaluation.id if evaluation else None,
                spec_sha256=version.spec_sha256,
                parent_policy=own["parent_policy"],
                notes=version.notes,
                sentence=version.notes.partition("\n")[0] or _summary_of(own["task"]),
                summary="",
                robot=own["robot"],
                task=own["task"],
                steps=sum(part["steps"] for part in version.lineage),
                training_s=sum(part["training_s"] for part in version.lineage),
                lineage=version.lineage,
                **summary,
            )
        )
    return cards


def _summary_of(task: str) -> str:
    """Return the summary of a task; empty if it is not installed, or broken."""
    found = plugins.find(plugins.TASKS, task)
    return "" if found is None else found.summary


def _part(summary: dict[str, Any]) -> dict[str, Any]:
    return {name: summary[name] for name in _SUMMARY if name in summary}
