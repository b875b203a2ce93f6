"""Connections to a real Postgres."""

from __future__ import annotations

import os
import resource
from collections.abc import Iterator

import pytest
from naojobs.database import make_engine, make_sessions
from naojobs.settings import ServiceSettings
from sqlalchemy import text


@pytest.fixture
def many_descriptors() -> Iterator[None]:
    """Use every descriptor below 1,100, like a service with many followers."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft < 2048:
        resource.setrlimit(resource.RLIMIT_NOFILE, (2048, hard))
    taken = [os.open(os.devnull, os.O_RDONLY)]
    while taken[-1] < 1100:
        taken.append(os.dup(taken[0]))
    yield
    for descriptor in taken:
        os.close(descriptor)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.usefixtures("many_descriptors")
def test_connections_with_large_descriptors_are_used_again(service_settings: ServiceSettings) -> None:
    engine = make_engine(service_settings.sqlalchemy_url, pool_size=1)
    try:
        for _ in range(2):
            with make_sessions(engine)() as session:
                assert session.connection().connection.driver_connection.fileno() > 1023  # type: ignore[union-attr]
                assert session.scalar(text("SELECT 1")) == 1
    finally:
        engine.dispose()
