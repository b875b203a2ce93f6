"""The settings: bad values are refused, and the message names the field."""

from __future__ import annotations

from typing import Any

import pytest
from naojobs.__main__ import main
from naojobs.settings import ServiceSettings
from pydantic import ValidationError

LOCAL: dict[str, Any] = {
    "mode": "local",
    "database_url": "postgresql://naosprint@/naosprint?host=/run",
    "broker_url": "redis://127.0.0.1:6379/0",
    "artifact_url": "file:///data",
}
PRODUCTION = {
    **LOCAL,
    "mode": "production",
    "database_url": "postgresql://naosprint:s3cr3t-of-my-own@db/naosprint",
    "broker_url": "redis://:another-of-my-own@broker/0",
}


@pytest.fixture(autouse=True)
def _no_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    import os

    for name in list(os.environ):
        if name.startswith("NAOSPRINT_"):
            monkeypatch.delenv(name)


def test_one_machine_needs_no_secrets_and_production_does() -> None:
    assert ServiceSettings(**LOCAL).mode == "local"
    assert ServiceSettings(**PRODUCTION).mode == "production"
    with pytest.raises(ValidationError, match="database_url: its password"):
        ServiceSettings(**{**LOCAL, "mode": "production"})


def test_production_is_the_default() -> None:
    with pytest.raises(ValidationError, match="password"):
        ServiceSettings(**{name: value for name, value in LOCAL.items() if name != "mode"})


@pytest.mark.parametrize("password", ["naosprint", "changeme", "postgres", "minioadmin", ""])
@pytest.mark.parametrize("field", ["database_url", "broker_url"])
def test_well_known_passwords_are_refused(field: str, password: str) -> None:
    url = PRODUCTION[field]
    scheme, rest = url.split("://")
    host = rest.split("@")[1]
    with pytest.raises(ValidationError, match=f"{field}: its password"):
        ServiceSettings(**{**PRODUCTION, field: f"{scheme}://user:{password}@{host}"})


def test_an_own_s3_server_needs_a_secret() -> None:
    s3 = {**PRODUCTION, "artifact_url": "s3://bucket/prefix", "s3_endpoint": "http://store:8333"}
    with pytest.raises(ValidationError, match="s3_secret_access_key"):
        ServiceSettings(**s3)
    with pytest.raises(ValidationError, match="s3_secret_access_key"):
        ServiceSettings(**s3, s3_access_key_id="minio", s3_secret_access_key="minioadmin")
    ServiceSettings(**s3, s3_access_key_id="id", s3_secret_access_key="of-my-own")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("database_url", "sqlite:///x.db"),
        ("database_url", "mysql://u:p@h/d"),
        ("broker_url", "amqp://h"),
        ("artifact_url", "file://relative/path"),
        ("artifact_url", "/plain/path"),
        ("artifact_url", "s3://"),
        ("artifact_url", "memory:///"),
    ],
)
def test_strange_urls_are_refused_by_name(field: str, value: str) -> None:
    with pytest.raises(ValidationError, match=field):
        ServiceSettings(**{**LOCAL, field: value})


def test_a_lease_outlives_a_lost_heartbeat() -> None:
    with pytest.raises(ValidationError, match="heartbeat_s"):
        ServiceSettings(**LOCAL, lease_s=15, heartbeat_s=10)


def test_urls_name_the_driver_that_reads_them_and_secrets_stay_out_of_logs() -> None:
    settings = ServiceSettings(**PRODUCTION)
    assert settings.sqlalchemy_url.startswith("postgresql+psycopg://naosprint:")
    assert settings.libpq_url.startswith("postgresql://naosprint:")
    assert "of-my-own" not in repr(settings)


def test_the_environment_fills_them(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in LOCAL.items():
        monkeypatch.setenv(f"NAOSPRINT_{name.upper()}", value)
    assert ServiceSettings().artifact_url == "file:///data"  # type: ignore[call-arg]


@pytest.mark.parametrize(
    "url",
    [
        "://user:{}@host/db",
        "://user:{}/{}@host/db",
        "://user:{}#{}@host/db",
        "://user:{}?{}@host/db",
        "://user:{}@{}@host/db",
        "://user:p@host:{}/db",
        "://user:{}@[host/db",
        "://user:{}\n@host/db",
        "{}",
    ],
)
@pytest.mark.parametrize("field", ["database_url", "broker_url"])
def test_no_error_shows_a_part_of_a_secret(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], field: str, url: str
) -> None:
    """Neither of a URL that cannot be read, nor because something else is wrong."""
    scheme = "postgresql" if field == "database_url" else "redis"
    secret = "verys3cret"
    value = url.replace("{}", secret)
    environment = {**PRODUCTION, field: f"{scheme}{value}" if value[0] == ":" else value, "artifact_url": "nonsense"}
    for name, text in environment.items():
        monkeypatch.setenv(f"NAOSPRINT_{name.upper()}", text)
    assert main(["migrate"]) == 2
    told = capsys.readouterr()
    assert secret not in told.out + told.err
    assert "NAOSPRINT_ARTIFACT_URL" in told.err
    if url not in ("://user:{}@host/db", "{}"):
        assert f"{field}: cannot be read" in told.err
