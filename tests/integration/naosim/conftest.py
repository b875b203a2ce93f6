from __future__ import annotations

from collections.abc import Iterator

import pytest
from naosim.simspark.server import Server

from .wire import Wire, serving


@pytest.fixture(autouse=True)
def hung_up() -> Iterator[None]:
    yield
    while Wire.wires:
        Wire.wires.pop().close()


@pytest.fixture
def server() -> Iterator[Server]:
    with serving(seed=1) as server:
        yield server
