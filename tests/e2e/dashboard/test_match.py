"""Matches in the browser: submitted with the form, played by a real worker, watched as replay and film."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import httpx
import pytest

if TYPE_CHECKING:
    from conftest import Browser

PLAY_S = 500.0  # a game of two seconds, its server and its agents start on a machine that is shared by many


@pytest.mark.timeout(1200)  # two servers and four agents start, one after the other
def test_a_match_from_the_form_to_its_film(browser: Browser, token: str, client: httpx.Client, pictures: Path) -> None:
    browser.sign_in(token)
    browser.open("/league")
    browser.find(".page-head button.primary").click()
    options = browser.until(lambda: [each.get_attribute("value") for each in browser.all("#match-teams option")])
    assert options[0] == "example"
    assert "example:walk=t1-run-robust" in options
    assert "example:getup=t1-getup" in options
    assert "example:keep=t1-keeper" in options
    browser.set("#match-team-b", "example:fly=t1-run")
    browser.set("#match-games", "1")
    browser.set("#match-players", "1")
    browser.set("#match-seconds", "1")
    browser.picture(pictures / "match-form.png")
    browser.js("document.querySelector('#match-film').value = 'all'")
    browser.find("dialog button[type=submit]").click()
    browser.shows("expected one of walk, kick, keep, getup", "dialog")
    browser.allowed.append("422")

    browser.set("#match-team-b", "example:walk=t1-run-robust")
    browser.find("dialog button[type=submit]").click()
    browser.shows("0 of 1 games")
    browser.shows("submitted", "[role=log]")
    browser.shows("game 1 ended", "[role=log]", PLAY_S)
    browser.shows("Succeeded", timeout_s=PLAY_S)

    browser.find("a[href$='/1']").click()
    browser.find(".stage.game canvas")
    browser.picture(pictures / "match-replay.png")
    robot = browser.find(".stage.game ~ .replay-bar select")
    assert len(robot.find_elements("css selector", "option")) == 3
    browser.js("arguments[0].value = '1'; arguments[0].dispatchEvent(new Event('change'));", robot)
    browser.picture(pictures / "match-replay-robot.png")
    browser.size(360, 740)
    browser.theme("dark")
    browser.picture(pictures / "match-replay-phone.png")
    assert browser.js("return document.documentElement.scrollWidth") == 360
    browser.size(1440, 900)
    browser.theme("light")
    browser.find("[data-action=film]").click()
    browser.find("video.film")
    length = browser.until(lambda: browser.js("const v = document.querySelector('video'); return v.duration || 0;"))
    assert 1.5 < length < 30.0
    browser.picture(pictures / "match-film.png")
    (match,) = client.get("/matches").json()["items"]
    assert match["film"] == "all"

    for place, name, words in ((f"/matches/{match['id']}", "match", "Results"), ("/league", "league", "1500")):
        browser.open(place)
        browser.shows(words)
        for width, height, theme in ((1440, 1400, "light"), (360, 1800, "dark")):
            browser.size(width, height)
            browser.theme(theme)
            assert browser.js("return document.documentElement.scrollWidth") == width
            browser.picture(pictures / f"{name}-{width}.png")
        browser.size(1440, 900)
        browser.theme("light")


def test_the_match_that_a_worker_plays_is_shown_live(
    browser: Browser, token: str, client: httpx.Client, pictures: Path
) -> None:
    body = {"teams": ["example", "example:walk=t1-run-robust"], "games": 50, "players": 1, "half_s": 300}
    match = client.post("/matches", json=body).raise_for_status().json()
    try:
        browser.sign_in(token)
        browser.open("/workers")
        link = browser.find(f"a[href='#/matches/{match['id']}']", PLAY_S)
        assert link.text == match["id"]
        link.click()
        browser.find(".stage.game canvas", PLAY_S)
        clock = browser.text(".board .muted")
        browser.until(lambda: browser.text(".board .muted") != clock, PLAY_S)
        browser.picture(pictures / "match-live.png")
    finally:
        client.post(f"/matches/{match['id']}/cancel").raise_for_status()
