"""Values that requests share for a second."""

from __future__ import annotations

from naosprint_api.recent import KEEP_S, Recent


def test_a_value_is_looked_up_once_while_it_is_kept() -> None:
    asked: list[str] = []
    now = 0.0

    def look_up(key: str) -> str | None:
        asked.append(key)
        return None if key == "unknown" else key.upper()

    recent = Recent(look_up, most=2, clock=lambda: now)
    assert recent.find("a") is None
    assert asked == []
    assert [recent.get("a"), recent.get("a"), recent.find("a")] == ["A", "A", "A"]
    assert asked == ["a"]
    assert [recent.get("unknown"), recent.get("unknown")] == [None, None]
    assert asked == ["a", "unknown", "unknown"], "what does not exist yet may exist at the next request"
    for key in "bc":
        recent.get(key)
    assert recent.find("a") is None, "the oldest makes place"
    recent.forget()
    assert recent.find("c") is None
    recent.get("c")
    now += KEEP_S
    assert recent.find("c") is None


def test_whether_a_key_had_a_value_is_known_for_longer_than_the_value_is_kept() -> None:
    values, now = {"a": "A"}, 0.0
    recent = Recent(values.get, most=2, clock=lambda: now)
    assert not recent.found("a")
    recent.get("a")
    now += 1000 * KEEP_S
    recent.forget()
    assert recent.found("a")
    del values["a"]
    recent.get("a")
    assert not recent.found("a"), "it has no value any more"
