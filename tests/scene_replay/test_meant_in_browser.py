"""What is meant to meet, in the page of a replay: marked there, folded at once, and saved as a triage file."""

import json
import re

import pytest
from replay_files import Page, replay
from usd_stages import resting_stage

from warp_bsc.usd.read.triage import read_triage

pytestmark = pytest.mark.browser

FLOOR, FALLS, RESTS = "/World/Floor", "/World/Falling", "/World/Resting"
REASON = 'stands <b>in</b> it, "by design" \u2014 \u00fc'


def text(browser, selector):
    return browser.value(f"document.querySelector({json.dumps(selector)}).textContent")


def rows(browser, table):
    return browser.value(f"[...document.querySelectorAll('#{table} tr[data-at]')].map((row) => row.textContent)")


def mark(browser, selector, number, reason, who=None):
    browser.click(selector, number)
    browser.type(reason)
    assert browser.value("byId('mark-do').disabled") == (who is not None)
    if who:
        browser.value("byId('mark-who').focus()")
        browser.type(who)
    browser.click("#mark-do")
    assert browser.value("byId('mark').hidden")


def save(browser, path):
    browser.value("URL.createObjectURL = (blob) => { window.saved = blob; return 'about:blank'; }")
    browser.value("HTMLAnchorElement.prototype.click = function () { window.savedAs = this.download; }")
    browser.click("#save-triage")
    assert browser.value("window.savedAs") == path.name
    path.write_text(browser.value("window.saved.text()"), encoding="utf-8")


def test_pairs_are_marked_folded_and_saved(tmp_path, browser):
    stage, triage = resting_stage(tmp_path), tmp_path / "scene.triage.json"
    page = replay(stage)[3]
    browser.open(page)
    assert browser.value("byId('meant-panel').hidden") and len(rows(browser, "pairs")) == 2
    found = browser.value("rows.count")
    resting = next(number for number, row in enumerate(rows(browser, "pairs")) if RESTS in row)
    assert resting == 1 and "from the start" in rows(browser, "pairs")[1]  # what begins later comes first
    assert browser.value("visibleRows({first: [0, 1], second: [1, 2]}).length") == 2
    mark(browser, "#pairs button[title='These are meant to meet']", resting, REASON, "ada")

    (pair,) = rows(browser, "pairs")
    assert FALLS in pair and not any(RESTS in row for row in rows(browser, "rows"))
    assert "more are meant" in text(browser, "#rows-count") and browser.value("table.rows.length") < found
    assert text(browser, "#verdict").endswith("Of these, 1 pair is marked as meant.")
    numbers = [browser.value(f"meshNumbers.get('{name}')") for name in (FLOOR, RESTS, FALLS)]
    block = f"{{first: [{numbers[0]}, {numbers[0]}], second: [{numbers[1]}, {numbers[2]}]}}"
    assert browser.value(f"visibleRows({block})") == [1]  # its contacts are not in the view
    assert not browser.value("byId('meant').open")
    browser.click("#meant summary")
    browser.wait("document.querySelectorAll('#meant-rows tr[data-at]').length === 1")
    (row,) = rows(browser, "meant-rows")
    assert FLOOR in row and RESTS in row and REASON in row and "ada, " in row
    assert browser.value("document.querySelectorAll('#meant-rows b').length") == 0  # text is inserted as text
    assert text(browser, "#unsaved").startswith("1 change not saved yet")
    save(browser, triage)
    assert text(browser, "#unsaved") == ""
    (entry,) = read_triage(triage)
    assert (entry.meshes, entry.reason, entry.who) == (tuple(sorted((FLOOR, RESTS))), REASON, "ada")
    assert entry.date == browser.value("new Date().toLocaleDateString('sv')")

    # The next replay reads the file; its page adds to it, and takes an entry out.
    page = replay(stage, "--triage", str(triage))[3]
    data = Page(page.read_text()).data
    assert [pair["meshes"] for pair in data["pairs"]] == [
        sorted((FLOOR, FALLS), reverse=data["pairs"][0]["meshes"][0] == FLOOR)
    ]
    browser.open(page)
    assert re.match(r"1 pair of meshes, \d+ collisions?, not counted", text(browser, "#meant-count"))
    browser.click("#mesh-list summary")
    browser.wait("document.querySelectorAll('#meshes tr[data-at]').length === 3")
    assert rows(browser, "meshes")[0].startswith(FALLS)
    mark(browser, "#meshes button[title='This mesh is meant to meet all others']", 0, "a ghost", "bo")
    assert rows(browser, "pairs") == []
    save(browser, triage)
    lines = triage.read_text(encoding="utf-8").splitlines()
    assert [json.loads(line.rstrip(","))["meshes"] for line in lines[1:-1]] == [[FALLS], sorted((FLOOR, RESTS))]
    browser.click("#meant summary")
    browser.wait("document.querySelectorAll('#meant-rows tr[data-at]').length === 2")
    browser.click("#meant-rows td button", 1)
    save(browser, triage)
    assert [entry.meshes for entry in read_triage(triage)] == [(FALLS,)]
    browser.click("#meant-rows td button", 0)
    assert len(rows(browser, "pairs")) == 1 and "meant" not in text(browser, "#rows-count")
    save(browser, triage)
    assert read_triage(triage) == ()
    assert browser.console == []


def test_a_clean_page_still_lists_what_is_meant(tmp_path, browser):
    stage, triage = resting_stage(tmp_path), tmp_path / "all.json"
    entry = {"meshes": [FLOOR], "reason": "soft ground", "who": "ada", "date": "2026-11-29"}
    triage.write_text(json.dumps({"version": 1, "meant": [entry]}))
    page = replay(stage, "--triage", str(triage), "--ignore", FALLS, RESTS)[3]
    browser.open(page)
    assert text(browser, "#nothing").startswith("Nothing collides") and browser.value("byId('pairs-panel').hidden")
    assert text(browser, "#meant-count").startswith("2 pairs of meshes, ")
    browser.click("#meant summary")
    browser.wait("document.querySelectorAll('#meant-rows tr[data-at]').length === 1")
    assert "with all others" in rows(browser, "meant-rows")[0] and browser.console == []
