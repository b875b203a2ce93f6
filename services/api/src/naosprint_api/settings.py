"""The settings of the API."""

from __future__ import annotations

from ipaddress import ip_network
from typing import Annotated, Any

from naojobs.quotas import Limits, Quota
from naojobs.settings import ServiceSettings
from pydantic import Field, IPvAnyNetwork, field_validator
from pydantic_settings import NoDecode


class ApiSettings(ServiceSettings):
    """Settings of the API, read from the environment with the prefix `NAOSPRINT_`."""

    api_host: str = Field("127.0.0.1", description="Address to listen on.")
    api_port: int = Field(8000, ge=0, le=65535, description="Port to listen on; 0: any free port.")
    api_trusted_proxies: str = Field(
        "",
        description="Addresses of proxies, whose X-Forwarded-* headers are trusted, separated by commas.",
    )
    api_max_connections_per_address: int = Field(
        1024, ge=1, description="Connections that one address may have open at a time; trusted proxies have no limit."
    )
    api_max_body_bytes: int = Field(1 << 20, ge=1024, le=1 << 30, description="The largest request body, in bytes.")
    api_rate_per_s: float = Field(100.0, gt=0, description="Requests per second that one token may make on average.")
    api_rate_burst: int = Field(400, ge=1, description="Requests that one token may make at once.")
    api_max_open_jobs: int = Field(2000, ge=1, description="Jobs of one owner that may wait or run at a time.")
    api_max_jobs: int = Field(20_000, ge=1, description="Jobs of one owner, open and ended.")
    api_max_evaluations: int = Field(50_000, ge=1, description="Evaluations of one owner, open and ended.")
    api_max_studies: int = Field(1000, ge=1, description="Studies of one owner, running and ended.")
    api_max_note_bytes: int = Field(
        10_000_000, ge=1, description="Bytes of the notes of one owner's jobs and versions of policies."
    )
    api_max_tokens: int = Field(
        1000, ge=1, description="Tokens of one owner that are valid or less than a day old, links included."
    )
    api_max_bytes: int = Field(
        200 << 30,
        ge=1,
        description="Bytes of one owner in the store at which nothing more is submitted; queued work may exceed them.",
    )
    api_max_rows: int = Field(
        100_000_000, ge=1, description="The same for rows of metrics, logs and events in the database."
    )
    api_max_policy_versions: int = Field(1000, ge=1, description="Versions of registered policies of one owner.")
    api_max_followers: int = Field(500, ge=1, description="Streams that may be open at a time.")
    api_max_followers_per_owner: int = Field(
        100,
        ge=1,
        description="Streams that one owner may have open at a time; links to the owner's jobs get half of them.",
    )
    api_recheck_s: float = Field(
        30.0,
        gt=0,
        le=50,
        description="Seconds between two checks that the token of an open stream is still valid.",
    )
    api_metrics_public: bool = Field(
        False,
        description="Whether /metrics may be read without a token; else it needs one with the scope metrics or admin.",
    )
    api_docs_url: str = Field(
        "",
        pattern=r"^(https?://.+/)?$",
        description="Address of the documentation's site, ending with a slash; the dashboard's pages link to it.",
    )
    api_max_webhooks: int = Field(20, ge=0, description="Webhooks that one owner may have.")
    api_webhook_networks: Annotated[tuple[IPvAnyNetwork, ...], NoDecode] = Field(
        (),
        description="Networks of private addresses that webhooks may point to, separated by commas, for example "
        "10.20.0.0/16,127.0.0.1/32; public addresses are always allowed.",
    )
    api_webhook_poll_s: float = Field(
        2.0, gt=0, le=60, description="Seconds between two checks for messages to send to webhooks."
    )
    api_docs_public: bool = Field(True, description="Whether /openapi.json is served.")

    @property
    def limits(self) -> Limits:
        """What each owner may have at most."""
        return {
            Quota.OPEN_JOBS: self.api_max_open_jobs,
            Quota.JOBS: self.api_max_jobs,
            Quota.EVALUATIONS: self.api_max_evaluations,
            Quota.STUDIES: self.api_max_studies,
            Quota.NOTES: self.api_max_note_bytes,
            Quota.TOKENS: self.api_max_tokens,
            Quota.WEBHOOKS: self.api_max_webhooks,
            Quota.VERSIONS: self.api_max_policy_versions,
            Quota.BYTES: self.api_max_bytes,
            Quota.ROWS: self.api_max_rows,
        }

    @field_validator("api_webhook_networks", mode="before")
    @classmethod
    def _split(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        try:
            return tuple(ip_network(part.strip()) for part in value.split(",") if part.strip())
        except ValueError as error:
            raise ValueError(f"api_webhook_networks: {error}; expected for example 10.20.0.0/16") from None
