"""Teams of the service: the example player with bundled or registered policies, and uploaded folders."""

from __future__ import annotations

import gzip
import io
import json
import os
import posixpath
import tarfile
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any, Literal
from zlib import error as ZlibError

import naopolicies
from naospec import TrainingSpec, plugins, read_stored
from naospec.teams import EXAMPLE, ROBOT, SKILLS, TEAM_FILE, example_name, no_team_file, skills_of, team_command
from pydantic import BaseModel, ConfigDict, ValidationError
from sqlalchemy import func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session
from sqlalchemy.sql.functions import Function

from naojobs import policies
from naojobs.archive import WholeTarInfo
from naojobs.database import Sessions
from naojobs.errors import ConflictError, InvalidError, NotFoundError
from naojobs.ids import new_id
from naojobs.models import Match, PolicyRecord, TeamRecord
from naojobs.quotas import NO_LIMITS, Limits, Quota, require_room
from naojobs.states import OPEN
from naojobs.store import ArtifactStore, StoreManifest, team_key

ARCHIVE = "team.tar"
"""Name of a team's archive in the store."""
Film = Literal["off", "goals", "all"]
"""What is filmed of a game: nothing, what led to goals, or all of it."""
MAX_TEAM_BYTES, MAX_TEAM_FILES = 64 << 20, 2_000
"""Bytes and files of an unpacked team."""
_MAX_NAME_BYTES, _MAX_PATH_BYTES, _MAX_TIME_S = 255, 1_000, 1 << 40
"""Limits of Linux's file systems, of which a worker's folder needs a part."""
_MAX_FILE_BYTES = 100_000
"""Bytes of a team.json, as for a match."""


class MatchTeam(BaseModel):
    """One side of a match: policies of the example player, or an uploaded team."""

    model_config = ConfigDict(frozen=True)

    name: str
    """Name for people: as given, with versions in place of aliases."""
    policies: dict[str, str] = {}
    """By skill, the name of a bundled policy or the id of a checkpoint."""
    team_id: str | None = None
    image: str | None = None
    """Container image that its agents run in."""


class MatchSpec(BaseModel):
    """What a match is, as it is stored."""

    model_config = ConfigDict(frozen=True)

    teams: tuple[MatchTeam, MatchTeam]
    games: int
    players: int
    half_s: float
    film: Film = "off"
    """What is filmed of every game."""
    gate: bool = False
    """Whether the match ends as soon as a sequential test has decided whether the first team does not lose."""


def find_team(session: Session, owner: str, text: str, field: str) -> MatchTeam:
    """Return the team that an owner names; a deletion of what it needs waits until the transaction has ended.

    Raises:
        InvalidError: for ``field``, with what to write.
    """
    if text.partition(":")[0] != EXAMPLE:
        session.execute(select(func.pg_advisory_xact_lock_shared(_key(owner))))
        found = session.scalar(select(TeamRecord).where(TeamRecord.owner == owner, TeamRecord.name == text))
        if found is None:
            known = session.scalars(select(TeamRecord.name).where(TeamRecord.owner == owner).order_by(TeamRecord.name))
            names = ", ".join([EXAMPLE, f"{EXAMPLE}:walk=POLICY", *known])
            raise InvalidError(f"no team {text!r}; use one of {names}, or upload a team", field)
        return MatchTeam(name=found.name, team_id=found.id, image=found.image)
    try:
        references = skills_of(text)
    except ValueError as error:
        raise InvalidError(str(error), field) from None
    found_policies = {skill: _policy(session, owner, skill, each, field) for skill, each in references.items()}
    name = example_name({skill: shown for skill, (shown, _) in found_policies.items()})
    return MatchTeam(name=name, policies={skill: used for skill, (_, used) in found_policies.items()})


def present_name(name: str, policies: Mapping[str, str]) -> str:
    """Return the name that a stored team has now: its version may have had other default policies.

    One with skills that this version does not have keeps its name.

    Args:
        name: the team's name.
        policies: its policies by skill; none of an uploaded team.
    """
    if not policies:
        return name
    try:
        mentioned = {skill: reference for skill, reference in skills_of(name).items() if f"{skill}=" in name}
    except ValueError:
        return name
    return example_name({**skills_of(EXAMPLE), **policies, **mentioned})


def _key(owner: str) -> Function[Any]:
    """Return the key of the lock on an owner's teams."""
    return func.hashtextextended(f"teams:{owner}", 0)


def _policy(session: Session, owner: str, skill: str, reference: str, field: str) -> tuple[str, str]:
    """Return the reference of the policy of a skill, and its name or checkpoint. Raises InvalidError."""
    if reference in naopolicies.names():
        shown = used = reference
        document = naopolicies.spec(reference)
    else:
        try:
            policy, version = policies.find(session, PolicyRecord.owner == owner, reference, keep=True)
        except NotFoundError as error:
            known = ", ".join(name for name in naopolicies.names() if name.startswith(ROBOT))
            raise InvalidError(f"{skill}: {error}; bundled policies are {known}", field) from None
        shown, used, document = f"{policy.name}@{version.number}", version.checkpoint_id, version.spec
    try:
        spec = read_stored(TrainingSpec, document).stage_specs[-1]
    except (ValidationError, plugins.BrokenPluginError):
        raise InvalidError(f"{skill}: this version cannot read policy {shown}; register a newer one", field) from None
    task = SKILLS[skill][0]
    if (spec.task.name, spec.robot.name) != (task, ROBOT):
        message = (
            f"{skill}: policy {shown} is for task {spec.task.name} and robot {spec.robot.name}; "
            f"use one for task {task} and robot {ROBOT}"
        )
        raise InvalidError(message, field)
    return shown, used


class TeamArchive:
    """Archive of a team's folder: a tar file, which may be compressed with gzip.

    Args:
        data: the archive.

    Raises:
        InvalidError: if it is none, has links, devices, a name twice or names that lead out of it, cannot be unpacked,
            is too large, or its team.json is missing, malformed, or reads folders outside.

    Attributes:
        data: the archive, not compressed.
        command: what its team.json says.
    """

    def __init__(self, data: bytes) -> None:
        try:
            self.data = _unpacked(data)
            with tarfile.open(fileobj=io.BytesIO(self.data), mode="r:", tarinfo=WholeTarInfo) as archive:
                member = _checked(archive).get(TEAM_FILE)
                if member is None or not member.isfile():
                    raise InvalidError(no_team_file("body"), "body")
                if member.size > _MAX_FILE_BYTES:
                    raise InvalidError(f"{TEAM_FILE}: at most {_MAX_FILE_BYTES:,} bytes; shorten it", "body")
                file = archive.extractfile(member)
                assert file is not None
                found = json.loads(file.read())
        except RecursionError:
            raise InvalidError(f"{TEAM_FILE}: too deeply nested; a list of texts is enough", "body") from None
        except (tarfile.TarError, OSError, EOFError, ZlibError) as error:
            raise InvalidError(f"expected a tar archive of the team's folder: {error}", "body") from None
        except ValueError as error:
            raise InvalidError(f"{TEAM_FILE}: {error}", "body") from None
        try:
            self.command = team_command(found, TEAM_FILE)
        except ValueError as error:
            raise InvalidError(str(error), "body") from None
        if self.command.reads:
            raise InvalidError(f"{TEAM_FILE}: reads: put what agents need into the folder; leave it out", "body")


def _unpacked(data: bytes) -> bytes:
    """Return an archive without its compression. Raises InvalidError if it is too large."""
    if data[:2] == b"\x1f\x8b":
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
            data = file.read(MAX_TEAM_BYTES + 1)
    if len(data) > MAX_TEAM_BYTES:
        raise InvalidError(f"a team has at most {MAX_TEAM_BYTES >> 20} MiB; leave out what agents do not need", "body")
    return data


def _checked(archive: tarfile.TarFile) -> dict[str, tarfile.TarInfo]:
    """Return the files and folders of an archive by the paths to which they are unpacked.

    Raises InvalidError for whatever else is in it, for two entries of one path, of which the last would count, and for
    what cannot be unpacked.
    """
    found: dict[str, tarfile.TarInfo] = {}
    for count, member in enumerate(archive, start=1):
        name, path = member.name, posixpath.normpath(member.name)
        if count > MAX_TEAM_FILES:
            raise InvalidError(f"a team has at most {MAX_TEAM_FILES:,} files and folders; pack fewer", "body")
        plain = member.isdir() or (member.isfile() and not member.issparse() and member.size >= 0 and path != ".")
        if not plain or ".." in name.split("/") or name.startswith("/"):
            raise InvalidError(f"{name[:200]!r}: pack only files and folders below the team's own", "body")
        encoded = os.fsencode(path)
        if b"\0" in encoded or len(encoded) > _MAX_PATH_BYTES or max(map(len, encoded.split(b"/"))) > _MAX_NAME_BYTES:
            raise InvalidError(f"{path[:200]!r}: is not a valid file name, or is too long; rename it", "body")
        if not abs(member.mtime) < _MAX_TIME_S:  # nor not a number
            raise InvalidError(f"{path[:200]!r}: has no valid modification time; pack it again", "body")
        if path in found:
            raise InvalidError(f"{path[:200]!r}: is in the archive twice; pack it once", "body")
        found[path] = member
    files = {path for path, member in found.items() if not member.isdir()}
    for path in found:
        if files.intersection(map(str, PurePosixPath(path).parents)):
            raise InvalidError(f"{path[:200]!r}: is below a file; pack a folder in its place", "body")
    return found


def upload_team(
    sessions: Sessions, store: ArtifactStore, *, owner: str, name: str, data: bytes, limits: Limits = NO_LIMITS
) -> TeamRecord:
    """Store a team under a name of its owner.

    Raises:
        InvalidError: if the archive is not a team's, or the name is not free.
        ConflictError: if the owner has a team of this name.
        QuotaError: if the owner has stored as much as ``limits`` allow.
        StoreError: if the store does not answer.
    """
    if name == EXAMPLE:
        raise InvalidError(f"{name} is the team of the example player; use another name", "name")
    archive = TeamArchive(data)
    with sessions.begin() as session:
        require_room(session, owner, limits, Quota.BYTES, more=len(archive.data))
    team_id = new_id("team")
    key = team_key(team_id)
    manifest = StoreManifest(files=(store.put_bytes(f"{key}/{ARCHIVE}", archive.data),))
    team = TeamRecord(
        id=team_id,
        owner=owner,
        name=name,
        key=key,
        manifest=manifest.model_dump(mode="json"),
        size=manifest.size,
        image=archive.command.image,
    )
    try:
        with sessions.begin() as session:
            require_room(
                session, owner, limits, Quota.BYTES, more=manifest.size
            )  # other uploads may have been stored meanwhile
            session.add(team)
            session.flush()
            session.refresh(team)
    except IntegrityError:  # the sweep deletes the file
        raise ConflictError(f"there is a team {name!r}; delete it first, or use another name", "name") from None
    return team


def list_teams(sessions: Sessions, owner: str | None, *, limit: int, after: str | None) -> list[TeamRecord]:
    """Return up to ``limit`` uploaded teams, those of an owner if one is given, oldest first."""
    wanted = select(TeamRecord).order_by(TeamRecord.id).limit(limit)
    if owner is not None:
        wanted = wanted.where(TeamRecord.owner == owner)
    if after is not None:
        wanted = wanted.where(TeamRecord.id > after)
    with sessions.begin() as session:
        return list(session.scalars(wanted))


def delete_team(sessions: Sessions, owner: str, name: str) -> str:
    """Delete a team and return its id; the caller deletes its archive. Matches that it has played stay.

    Raises NotFoundError, and ConflictError if an open match needs it.
    """
    with sessions.begin() as session:
        session.execute(select(func.pg_advisory_xact_lock(_key(owner))))
        wanted = select(TeamRecord).where(TeamRecord.owner == owner, TeamRecord.name == name)
        team = session.scalar(wanted)
        if team is None:
            raise NotFoundError(f"{owner} has no team {name!r}")
        plays = Match.spec["teams"].contains([{"team_id": team.id}])
        busy = session.scalar(select(Match.id).where(Match.state.in_(OPEN), plays).limit(1))
        if busy is not None:
            raise ConflictError(f"match {busy} needs team {name}; wait for its end, or cancel it")
        session.delete(team)
        return team.id
