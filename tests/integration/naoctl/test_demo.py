"""The last part of the demonstration: a bundled policy beside the one that was trained."""

from __future__ import annotations

import io
from pathlib import Path

import naopolicies
import pytest
from naoctl import demo
from naoctl.commands.policies import evaluate
from naoctl.context import Context
from naoctl.evaluations import headline
from naoctl.stack.layout import Layout
from rich.console import Console


def test_a_bundled_policy_is_shown_beside_the_one_just_trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "BUNDLED_EPISODES", 4)
    monkeypatch.setattr(demo, "BUNDLED_FILM_S", 0.1)
    name = demo.bundled_policy("nao-0")
    assert name == "sprint"
    trained = evaluate(name, episodes=2)
    out = io.StringIO()
    context = Context(out=Console(file=out, width=200))
    demo.Demo(context, Layout.at(tmp_path / "data"), tmp_path).show_bundled(
        name, {"summary": trained}, tmp_path / "run"
    )
    lines = {line[:12].strip(): line[12:] for line in out.getvalue().splitlines()}
    bundled = evaluate(name, episodes=4)
    for text in headline(trained).values():
        assert text in lines["Trained"]
    for text in headline(bundled).values():
        assert text in lines["Sprint"]
    assert f"after {naopolicies.card(name)['steps']:,} steps" in lines["Sprint"]
    film = tmp_path / "run" / "replay.mp4"
    assert lines["Film"] == film.resolve().as_uri()
    assert b"ftyp" in film.read_bytes()[:12]
