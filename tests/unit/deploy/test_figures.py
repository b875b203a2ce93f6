"""The Grafana board and the alerts query metrics that the API reports, with their labels."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from naosprint_api.telemetry import Telemetry
from prometheus_client import CollectorRegistry
from prometheus_client.platform_collector import PlatformCollector
from prometheus_client.process_collector import ProcessCollector

DEPLOY = Path(__file__).parents[3] / "deploy"

ASKED = re.compile(r"\b((?:naosprint|process)_[a-z_]+)\b(?:\{([^}]*)\})?")
"""A metric of the API or of the process in an expression, with its selector."""
EXPORTED = re.compile(r"\bup{|\b(?:pg|redis|SeaweedFS)_[a-z_]+")
"""What Prometheus itself and the exporters report."""
LABEL = re.compile(r"(\w+)\s*(?:=~|!~|!=|=)")
GROUPED = re.compile(r"\bby\s*\(([^)]*)\)")


def series() -> dict[str, set[str]]:
    """Return the names under which Prometheus finds each metric, with their labels."""
    found: dict[str, set[str]] = {}
    for name, kind, labels, _ in Telemetry.catalogue():
        parts = ("_bucket", "_count", "_sum") if kind == "histogram" else ("",)
        for part in parts:
            found[name + part] = {*labels, *(("le",) if part == "_bucket" else ())}
    registry = CollectorRegistry()
    ProcessCollector(registry=registry)
    PlatformCollector(registry=registry)
    for family in registry.collect():
        for sample in family.samples:
            found[sample.name] = set(sample.labels)
    return found


def expressions() -> Iterator[tuple[str, str]]:
    board = json.loads((DEPLOY / "grafana" / "boards" / "naosprint.json").read_text(encoding="utf-8"))
    for panel in board["panels"]:
        for target in panel["targets"]:
            yield f"board: {panel['title']}", target["expr"]
    alerts = yaml.safe_load((DEPLOY / "prometheus" / "alerts.yml").read_text(encoding="utf-8"))
    for group in alerts["groups"]:
        for rule in group["rules"]:
            yield f"alert: {rule['alert']}", rule["expr"]


@pytest.mark.parametrize(("where", "expression"), list(expressions()))
def test_a_question_is_about_figures_that_exist(where: str, expression: str) -> None:
    known = series()
    asked = ASKED.findall(expression)
    assert asked or EXPORTED.search(expression), "queries none of the project's metrics"
    for name, selector in asked:
        assert name in known, f"{name} is not reported"
        assert set(LABEL.findall(selector)) <= known[name] | {"job", "instance"}, name
    allowed = {label for name, _ in asked for label in known[name]} | {"job", "instance"}
    for group in GROUPED.findall(expression):
        assert {label.strip() for label in group.split(",") if label.strip()} <= allowed


def test_the_board_shows_every_figure_of_the_service() -> None:
    text = "".join(expression for _, expression in expressions())
    missing = [name for name, *_ in Telemetry.catalogue() if name not in text]
    assert missing == []


def test_the_board_is_provisioned_where_compose_puts_it() -> None:
    compose = yaml.safe_load((DEPLOY.parent / "docker-compose.yml").read_text(encoding="utf-8"))
    mounted = dict(volume.split(":")[:2] for volume in compose["services"]["grafana"]["volumes"])
    provider = yaml.safe_load((DEPLOY / "grafana" / "provisioning" / "dashboards" / "boards.yml").read_text())
    (path,) = (one["options"]["path"] for one in provider["providers"])
    assert mounted["./deploy/grafana/boards"] == path
    board = json.loads((DEPLOY / "grafana" / "boards" / "naosprint.json").read_text(encoding="utf-8"))
    sources = yaml.safe_load((DEPLOY / "grafana" / "provisioning" / "datasources" / "prometheus.yml").read_text())
    uids = {source["uid"] for source in sources["datasources"]}
    assert {panel["datasource"]["uid"] for panel in board["panels"] if "datasource" in panel} <= uids
