"""The settings that every process of the service shares."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Literal, Self
from urllib.parse import parse_qsl, urlsplit

from pydantic import Field, SecretStr, ValidationError, ValidationInfo, field_validator, model_validator
from pydantic.fields import FieldInfo
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SettingsConfigDict, SettingsError

DEFAULT_SECRETS = frozenset(
    {"", "naosprint", "postgres", "password", "changeme", "changethis", "secret", "minio", "minioadmin", "admin"},
)
"""Passwords from examples and images: allowed on one machine, refused in production."""


SETTINGS_ERRORS = (ValidationError, SettingsError)
"""Errors of settings that are missing or wrong, for `settings_words`."""


def settings_words(error: ValidationError | SettingsError) -> str:
    """Return what is wrong with the environment, one variable a line, without any value."""
    if isinstance(error, SettingsError):
        return f"{error}\n"
    lines = []
    for item in error.errors(include_input=False, include_url=False):
        name = "NAOSPRINT_" + "_".join(str(part) for part in item["loc"]).upper() if item["loc"] else ""
        lines.append(f"{name} {item['msg'].removeprefix('Value error, ')}\n".lstrip())
    return "".join(lines)


class _SecretFiles(PydanticBaseSettingsSource):
    """Secrets from files: `NAOSPRINT_DATABASE_URL_FILE` names a file with the value of `NAOSPRINT_DATABASE_URL`."""

    def get_field_value(self, field: FieldInfo, field_name: str) -> tuple[Any, str, bool]:
        """Return the content of the field's file without the newline at its end, or none."""
        name = f"{self.config.get('env_prefix', '')}{field_name}".upper()
        path = os.environ.get(f"{name}_FILE")
        if not path or SecretStr not in (field.annotation, *getattr(field.annotation, "__args__", ())):
            return None, field_name, False
        if os.environ.get(name):
            raise SettingsError(f"{name} and {name}_FILE are both set; set one of them")
        try:
            return Path(path).read_text(encoding="utf-8").removesuffix("\n"), field_name, False
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
            raise SettingsError(f"{name}_FILE: cannot read {path}: {reason}") from None

    def __call__(self) -> dict[str, Any]:
        """Return the values of all fields that have a file."""
        found = {name: self.get_field_value(field, name)[0] for name, field in self.settings_cls.model_fields.items()}
        return {name: value for name, value in found.items() if value is not None}


class FileSettings(BaseSettings):
    """Settings from the environment with the prefix `NAOSPRINT_`, secrets also from files (`NAOSPRINT_..._FILE`)."""

    model_config = SettingsConfigDict(env_prefix="NAOSPRINT_", extra="ignore", frozen=True, hide_input_in_errors=True)

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Return where settings come from, the first one first."""
        return init_settings, _SecretFiles(settings_cls), env_settings


class DatabaseSettings(FileSettings):
    """Settings of a process that uses the database only."""

    mode: Literal["local", "production"] = Field(
        "production",
        description="`local` allows a database, a broker and a store without a secret; `production` refuses them.",
    )
    database_url: SecretStr = Field(description="Postgres, e.g. postgresql://user:password@host:5432/naosprint")

    @field_validator("database_url", "broker_url", check_fields=False)
    @classmethod
    def _is_url(cls, value: SecretStr, info: ValidationInfo) -> SecretStr:
        """Refuse what programs behind would read differently: their errors would show a part of the password."""
        text = value.get_secret_value()
        try:
            parts = urlsplit(text)
            readable = parts.port != 0 and parts.netloc.count("@") <= 1 and not parts.fragment
        except ValueError:
            readable = False
        if not readable or not text.isprintable():
            raise ValueError(
                f"{info.field_name}: cannot be read; in a password write %23 for #, %2F for /, %3A for :, %3F for ?, "
                "%40 for @"
            )
        return value

    @field_validator("database_url")
    @classmethod
    def _is_postgres(cls, value: SecretStr) -> SecretStr:
        scheme = urlsplit(value.get_secret_value()).scheme
        if scheme not in {"postgresql", "postgres", "postgresql+psycopg"}:
            raise ValueError(f"database_url: scheme {scheme!r} is not Postgres; use postgresql://user:password@host/db")
        return value

    @model_validator(mode="after")
    def _refuse_default_passwords(self) -> Self:
        for name in ("database_url", "broker_url"):
            url = getattr(self, name, None)
            if self.mode == "local" or url is None:
                continue
            if (urlsplit(url.get_secret_value()).password or "") in DEFAULT_SECRETS:
                raise ValueError(
                    f"{name}: its password is missing or a well-known default; "
                    "set a password of your own, or set NAOSPRINT_MODE=local on a machine of your own",
                )
        return self

    @property
    def sqlalchemy_url(self) -> str:
        """Return the database URL with the name of the psycopg driver, as SQLAlchemy expects it."""
        rest = self.database_url.get_secret_value().split("://", 1)[1]
        return f"postgresql+psycopg://{rest}"

    @property
    def libpq_url(self) -> str:
        """Return the database URL without a driver, as psycopg expects it."""
        rest = self.database_url.get_secret_value().split("://", 1)[1]
        return f"postgresql://{rest}"


class ServiceSettings(DatabaseSettings):
    """Settings of the job service, read from the environment with the prefix `NAOSPRINT_`."""

    broker_url: SecretStr = Field(description="Redis-protocol broker, e.g. redis://:password@host:6379/0")
    artifact_url: str = Field(description="Artifact store: file:///absolute/folder or s3://bucket/prefix")
    database_pool_size: int = Field(10, ge=1, le=200, description="Database connections that a process keeps open.")

    s3_endpoint: str | None = Field(None, description="S3 endpoint where it is not Amazon's, e.g. http://store:8333")
    s3_region: str = Field("us-east-1", description="S3 region.")
    s3_access_key_id: SecretStr | None = Field(None, description="S3 access key id.")
    s3_secret_access_key: SecretStr | None = Field(None, description="S3 secret access key.")

    lease_s: float = Field(30.0, gt=0, le=3600, description="Seconds after a heartbeat at which a lease is stale.")
    heartbeat_s: float = Field(10.0, gt=0, le=3600, description="Seconds between two heartbeats of a worker.")

    @field_validator("broker_url")
    @classmethod
    def _is_redis(cls, value: SecretStr) -> SecretStr:
        scheme = urlsplit(value.get_secret_value()).scheme
        if scheme not in {"redis", "rediss", "redis+socket"}:
            raise ValueError(f"broker_url: scheme {scheme!r} is not a Redis-protocol broker; use redis://host:6379/0")
        allowed = {"ssl_ca_certs": None, "ssl_cert_reqs": "required", "ssl_check_hostname": "true"}
        for name, text in parse_qsl(urlsplit(value.get_secret_value()).query) if scheme == "rediss" else ():
            if name not in allowed or allowed[name] not in (None, text.lower()):
                raise ValueError(
                    f"broker_url: {name} cannot be changed; rediss:// always checks the broker's certificate, by the "
                    "authority in the file that ssl_ca_certs names"
                )
        return value

    @field_validator("artifact_url")
    @classmethod
    def _is_store(cls, value: str) -> str:
        parts = urlsplit(value)
        if parts.scheme == "file" and parts.netloc == "" and parts.path.startswith("/"):
            return value
        if parts.scheme == "s3" and parts.netloc and "@" not in parts.netloc:
            return value
        raise ValueError("artifact_url: is neither file:///absolute/folder nor s3://bucket/prefix")

    @model_validator(mode="after")
    def _refuse_default_secrets(self) -> Self:
        if self.heartbeat_s * 2 > self.lease_s:
            raise ValueError("heartbeat_s: must be at most half of lease_s, so that one lost heartbeat loses no lease")
        if self.mode == "local":
            return self
        if self.artifact_url.startswith("s3:") and self.s3_endpoint is not None:
            secret = self.s3_secret_access_key.get_secret_value() if self.s3_secret_access_key else ""
            if secret in DEFAULT_SECRETS:
                raise ValueError("s3_secret_access_key: missing or a well-known default; set one of your own")
        return self
