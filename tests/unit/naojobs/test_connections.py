"""Bounds of connections to the database, and that every connection has them."""

from __future__ import annotations

import ast
from pathlib import Path

from naojobs.connections import BOUNDS, bounds

ROOT = Path(__file__).parents[3]
CONNECTING = {"psycopg.connect", "psycopg.AsyncConnection.connect", "create_engine", "optuna.storages.RDBStorage"}
"""Calls that open connections."""


def test_a_url_has_precedence() -> None:
    assert bounds("postgresql://naosprint:a%40b@postgres:5432/naosprint") == BOUNDS
    assert bounds("postgresql+psycopg://naosprint@/naosprint?host=/run/x") == BOUNDS
    own = bounds("postgresql+psycopg://a@one,two/b?tcp_user_timeout=90000&connect_timeout=9")
    assert own == {name: value for name, value in BOUNDS.items() if name not in ("tcp_user_timeout", "connect_timeout")}
    assert bounds("postgresql://h/b?of_no_use=1") == BOUNDS


def test_a_silent_host_is_given_up_within_20_s() -> None:
    assert BOUNDS["tcp_user_timeout"] == 20_000  # milliseconds
    assert BOUNDS["keepalives_idle"] + BOUNDS["keepalives_count"] * BOUNDS["keepalives_interval"] <= 25


def sources() -> list[Path]:
    found = [ROOT / "migrations" / "env.py"]
    for folder in ("packages", "services"):
        found += (ROOT / folder).glob("*/src/**/*.py")
    return found


def unbound(node: ast.AST, place: ast.AST) -> list[str]:
    """Return the calls below a node that connect without bounds; they are named in the function around the call."""
    found = []
    for child in ast.iter_child_nodes(node):
        if (
            isinstance(child, ast.Call)
            and ast.unparse(child.func) in CONNECTING
            and "bounds(" not in ast.unparse(place)
        ):
            found.append(ast.unparse(child))
        found += unbound(child, child if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef) else place)
    return found


def test_every_connection_has_bounds() -> None:
    texts = {path: text for path in sources() if "connect" in (text := path.read_text(encoding="utf-8"))}
    assert all(f"{name}(" in "".join(texts.values()) for name in CONNECTING)
    trees = {path: ast.parse(text) for path, text in texts.items()}
    found = {path.relative_to(ROOT).as_posix(): unbound(tree, tree) for path, tree in trees.items()}
    assert {path: calls for path, calls in found.items() if calls} == {}
