"""`naoctl tune`: flags to a search."""

from __future__ import annotations

import pytest
from naoctl.commands.studies import make_search
from naoctl.errors import InvalidInput


def test_flags_become_a_search() -> None:
    space = [
        "learning_rate=1e-4..1e-2:log",
        "--n-epochs=3..9",
        "hidden_sizes=64,64|32",
        "symmetric_policy=true|false",
        "target_kl=none|0.02",
        "total_steps=250k..1M",
    ]
    search = make_search(space, ["fall_rate", "speed_mps:max"], trials=7)
    assert search["space"] == {
        "learning_rate": {"type": "float", "low": 1e-4, "high": 1e-2, "log": True, "step": None},
        "n_epochs": {"type": "int", "low": 3, "high": 9, "log": False, "step": None},
        "hidden_sizes": {"type": "choice", "choices": [[64, 64], [32]]},
        "symmetric_policy": {"type": "choice", "choices": [True, False]},
        "target_kl": {"type": "choice", "choices": [None, 0.02]},
        "total_steps": {"type": "int", "low": 250_000, "high": 1_000_000, "log": False, "step": None},
    }
    assert search["objectives"] == [
        {"metric": "fall_rate", "direction": None},
        {"metric": "speed_mps", "direction": "maximize"},
    ]
    assert search["trials"] == 7


@pytest.mark.parametrize(
    ("space", "objectives", "words"),
    [
        ([], [], "--space is missing"),
        (["learning_rate"], [], "is not FIELD=RANGE"),
        (["wings=1..2"], [], "no setting wings"),
        (["gamma=0.9"], [], "neither LOW..HIGH nor A|B"),
        (["gamma=a..b"], [], "is not LOW..HIGH"),
        (["n_epochs=5..20.9"], [], "n_epochs is a whole number"),
        (["gamma=0.9..0.99:cubic"], [], "unknown scale 'cubic'"),
        (["gamma=0.9..0.99", "gamma=1|2"], [], "given twice"),
        (["gamma=0.99..0.9"], [], "space.gamma: high: expected a number above low"),
        (["gamma=0..1:log"], [], "needs a positive lower end"),
        (["gamma=0.9..0.99"], ["speed_mps:up"], "neither :max nor :min"),
        (["gamma=0.9..0.99"], ["speed_mps", "speed_mps"], "given twice"),
    ],
)
def test_wrong_flags_are_named(space: list[str], objectives: list[str], words: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        make_search(space, objectives)
    assert words in str(caught.value)
