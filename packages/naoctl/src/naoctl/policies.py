"""Look-up of policies by name: bundled ones, and versions of registered ones."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from naoctl.client import ApiError, Client
from naoctl.context import find_job
from naoctl.errors import CliError, ExitCode
from naoctl.transfer import plain_name

REFERENCE = re.compile(r"[a-z0-9-]{1,60}(@[a-z0-9-]{1,60})?")


@dataclass(frozen=True)
class Trained:
    """Job or policy that a command's argument names."""

    job: dict[str, Any] | None
    """None for a bundled policy."""
    policy: dict[str, Any] | None = None
    """None for a job."""

    @property
    def folder(self) -> str:
        """Plain folder name made of the job's name and id, or of the policy's reference."""
        if self.policy is not None:
            return plain_name(self.policy["reference"], "policy")
        assert self.job is not None
        return folder_name(self.job)


def folder_name(job: dict[str, Any]) -> str:
    """Return a plain folder name for a job: its name if possible, with the end of its id."""
    return f"{plain_name(job['name'], 'job')}-{plain_name(str(job['id'])[-6:])}"


def checkpoint_folder(step: int) -> str:
    """Return the name of the folder of a checkpoint."""
    return f"checkpoint-{step:012d}"


def policy_path(reference: str) -> str:
    """Return the address of a policy."""
    return f"/policies/{quote(reference, safe='@')}"


def find_policy(client: Client, reference: str) -> dict[str, Any] | None:
    """Return a bundled policy or a version of a registered one with its files; None if there is none."""
    if not REFERENCE.fullmatch(reference):
        return None
    try:
        found: dict[str, Any] = client.get(policy_path(reference))
    except ApiError as error:
        if error.status == 404:
            return None
        raise
    return found


def known_policy(client: Client, reference: str) -> dict[str, Any]:
    """Return a policy as `find_policy` does. Raises CliError if there is none."""
    if not REFERENCE.fullmatch(reference):
        raise CliError(
            f"{reference!r} is no name of a policy", fix="Use NAME, NAME@VERSION or NAME@ALIAS.", code=ExitCode.USAGE
        )
    found: dict[str, Any] = client.get(policy_path(reference))
    return found


def find_trained(client: Client, reference: str) -> Trained:
    """Return the job or the policy that a reference names; of both the job, except with a version: NAME@VERSION.

    Raises:
        CliError: if there is neither.
    """
    text = reference.strip()
    if "@" in text and (policy := find_policy(client, text)) is not None:
        return _trained(client, policy)
    try:
        return Trained(find_job(client, text))
    except CliError as error:
        if error.code is not ExitCode.NOT_FOUND:
            raise
        if "@" in text:
            return _trained(client, known_policy(client, text))
        if (policy := find_policy(client, text)) is None:
            raise
    return _trained(client, policy)


def _trained(client: Client, policy: dict[str, Any]) -> Trained:
    job = client.get(f"/jobs/{policy['job_id']}") if policy["job_id"] else None
    return Trained(job, policy)
