"""Every alert has a test that fires it, and none fires for a service in order."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

PROMETHEUS = Path(__file__).parents[3] / "deploy" / "prometheus"
ALERT = re.compile(r'alertname="(\w+)"')


def alerts() -> set[str]:
    rules = yaml.safe_load((PROMETHEUS / "alerts.yml").read_text(encoding="utf-8"))
    return {rule["alert"] for group in rules["groups"] for rule in group["rules"]}


def expected() -> Iterator[tuple[str, str, int]]:
    """Yield each test's name with an alert and how many of it must fire."""
    for test in yaml.safe_load((PROMETHEUS / "alerts_test.yml").read_text(encoding="utf-8"))["tests"]:
        for case in test["promql_expr_test"]:
            (alert,) = ALERT.findall(case["expr"])
            (sample,) = case["exp_samples"]
            yield test["name"], alert, sample["value"]


def test_each_alert_is_fired_by_a_test_and_is_silent_in_order() -> None:
    assert {alert for _, alert, count in expected() if count == 1} == alerts()
    assert {alert for name, alert, count in expected() if (name, count) == ("in order", 0)} == alerts()


@pytest.mark.skipif(shutil.which("promtool") is None, reason="promtool (Debian: prometheus) is not installed")
def test_prometheus_fires_each_alert() -> None:
    done = subprocess.run(
        ["promtool", "test", "rules", "alerts_test.yml"], cwd=PROMETHEUS, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
