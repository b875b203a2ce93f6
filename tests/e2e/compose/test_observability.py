"""Profile `observability`: Prometheus reads the service, and every metric of the board exists."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest

ROOT = Path(__file__).parents[3]

ASK = "wget -q -O - 'http://127.0.0.1:9090/api/v1/{}'"
"""Answers a question to Prometheus's HTTP interface from inside of its network."""

METRIC = re.compile(r"\b(?:naosprint|process)_[a-z_]+\b")
"""A metric's name in an expression, and what a histogram's series add to its name."""
HISTOGRAM_PART = re.compile(r"_(?:bucket|count|sum)$")


@pytest.fixture(scope="module")
def prometheus(project: Any, wait_for: Callable[..., Any]) -> Iterator[Callable[..., Any]]:
    """Prometheus after its first look at the API; ask it with a path."""
    if project.has_registry:
        project.compose("pull", "--quiet", "prometheus", "grafana", timeout_s=600)
    else:
        project.compose("build", "prometheus", timeout_s=900)
    project.compose("up", "--detach", "--no-build", "--wait", "prometheus")

    def ask(path: str) -> Any:
        answer = json.loads(project.compose("exec", "-T", "prometheus", "sh", "-c", ASK.format(path)).stdout)
        assert answer["status"] == "success", answer
        return answer["data"]

    def looked() -> bool:
        health = [target["health"] for target in ask("targets")["activeTargets"]]
        return bool(health) and "unknown" not in health

    wait_for(looked, 90, "Prometheus did not look at its targets")
    yield ask
    project.compose("--profile", "observability", "rm", "--stop", "--force", "prometheus", "grafana")


def test_prometheus_reads_the_api_with_its_token(prometheus: Callable[..., Any]) -> None:
    """The exporters are not started here, and the store's stand-in has no metrics."""
    targets = {target["labels"]["job"]: target for target in prometheus("targets")["activeTargets"]}
    for job in ("naosprint", "prometheus"):
        assert (targets[job]["health"], targets[job]["lastError"]) == ("up", "")


def test_a_second_start_makes_no_second_token(project: Any, prometheus: Callable[..., Any]) -> None:
    project.compose("up", "--detach", "--no-build", "--wait", "--force-recreate", "prometheus")
    listed = json.loads(project.compose("exec", "-T", "api", "python", "-m", "naojobs", "token", "list").stdout)
    assert [token["owner"] for token in listed].count("prometheus") == 1


def test_every_alert_is_loaded_and_asks_for_figures_that_exist(prometheus: Callable[..., Any]) -> None:
    (group,) = prometheus("rules")["groups"]
    assert len(group["rules"]) >= 5
    assert [rule["name"] for rule in group["rules"] if rule["health"] not in ("ok", "unknown")] == []


def test_every_figure_of_the_board_exists(prometheus: Callable[..., Any], wait_for: Callable[..., Any]) -> None:
    wait_for(lambda: "naosprint_jobs" in prometheus("metadata"), 60, "Prometheus read nothing of the API")
    board = json.loads((ROOT / "deploy" / "grafana" / "boards" / "naosprint.json").read_text(encoding="utf-8"))
    asked = [(panel["title"], target["expr"]) for panel in board["panels"] for target in panel["targets"]]
    assert len(asked) > 10
    reported = prometheus("metadata")  # including metrics without any count yet
    for title, expression in asked:
        prometheus(f"query?query={quote(expression)}")  # it is well formed
        unknown = {name for name in METRIC.findall(expression) if HISTOGRAM_PART.sub("", name) not in reported}
        assert not unknown, f"{title}: not reported: {unknown}"


def test_grafana_shows_the_board(project: Any, prometheus: Callable[..., Any]) -> None:
    if not project.has_registry:
        pytest.skip("needs an image registry: Debian has no Grafana")
    project.compose("up", "--detach", "--no-build", "--wait", "grafana")
    ask = (
        'wget -q -O - "http://admin:$GF_SECURITY_ADMIN_PASSWORD@127.0.0.1:3000/api/dashboards/uid/naosprint" '
        '&& wget -q -O - "http://admin:$GF_SECURITY_ADMIN_PASSWORD@127.0.0.1:3000/api/datasources/uid/prometheus/health"'
    )
    answer = project.compose("exec", "-T", "grafana", "sh", "-c", ask).stdout
    assert '"title":"naosprint"' in answer.replace(": ", ":") and '"status":"OK"' in answer.replace(": ", ":")
