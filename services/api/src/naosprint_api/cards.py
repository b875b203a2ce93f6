"""Cards of policies: bundled ones from their files, versions of registered ones from the database."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cache
from typing import Any

import naopolicies
from naojobs.database import Sessions
from naojobs.models import Checkpoint, Policy, PolicyVersion
from naojobs.policies import aliases_of
from naojobs.store import Manifest
from sqlalchemy import ColumnElement, func, select
from sqlalchemy.orm import Session

from naosprint_api.results import summaries_of
from naosprint_api.schemas import FilePublic, PolicyCard, PolicyDetails
from naosprint_api.views import files_view

#: Files of a bundled policy that make it a checkpoint.
BUNDLED_FILES = (naopolicies.CHECKPOINT, naopolicies.WEIGHTS)

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


def newest_cards(sessions: Sessions, owned: ColumnElement[bool]) -> list[PolicyCard]:
    """Return the newest version of each registered policy that meets `owned`, by name."""
    newest = (
        select(PolicyVersion.policy_id, func.max(PolicyVersion.number).label("number"))
        .group_by(PolicyVersion.policy_id)
        .subquery()
    )
    statement = (
        select(Policy, PolicyVersion)
        .join(PolicyVersion, PolicyVersion.policy_id == Policy.id)
        .join(newest, (newest.c.policy_id == PolicyVersion.policy_id) & (newest.c.number == PolicyVersion.number))
        .where(owned)
        .order_by(Policy.name, Policy.owner)
    )
    with sessions.begin() as session:
        return _cards(session, [(policy, version) for policy, version in session.execute(statement)])


def version_cards(sessions: Sessions, policy: Policy) -> list[PolicyCard]:
    """Return all versions of a registered policy, newest first."""
    statement = select(PolicyVersion).where(PolicyVersion.policy_id == policy.id).order_by(PolicyVersion.number.desc())
    with sessions.begin() as session:
        return _cards(session, [(policy, version) for version in session.scalars(statement)])


def version_details(sessions: Sessions, policy: Policy, version: PolicyVersion) -> PolicyDetails:
    """Return a version of a registered policy with its specification and its files."""
    with sessions.begin() as session:
        (card,) = _cards(session, [(policy, version)])
        checkpoint = session.get_one(Checkpoint, version.checkpoint_id)
    files = files_view(Manifest.model_validate(checkpoint.manifest), f"/checkpoints/{checkpoint.id}")
    return PolicyDetails(**dict(card), spec=version.spec, files=files)


def _cards(session: Session, rows: Sequence[tuple[Policy, PolicyVersion]]) -> list[PolicyCard]:
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


def _part(summary: dict[str, Any]) -> dict[str, Any]:
    return {name: summary[name] for name in _SUMMARY if name in summary}
