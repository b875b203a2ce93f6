"""What tests of the whole service share."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest


@pytest.fixture(scope="session")
def wait_for() -> Callable[..., Any]:
    """Wait until something is true and return it."""

    def wait(what: Callable[[], Any], timeout_s: float, failure: str) -> Any:
        deadline = time.monotonic() + timeout_s
        while not (found := what()):
            if time.monotonic() > deadline:
                pytest.fail(f"{failure} within {timeout_s:g} s")
            time.sleep(0.2)
        return found

    return wait
