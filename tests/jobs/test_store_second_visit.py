# SPDX-License-Identifier: Apache-2.0
"""A store that gets a second visit, run in the map of the first, tells what that changed and holds what came."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_line import succeed

RUN = ("--no-eval", "--scale", "0.5", "--iterations", "1")


@pytest.mark.long("two runs of 80 frames of a room in which a chair is added")
def test_what_a_second_visit_brought_is_told_and_comes_in_once_its_cells_are_due(tmp_path: Path) -> None:
    for visit in ("1", "2"):
        succeed("synth", tmp_path / f"v{visit}", "--changes", "4", "--visit", visit, "--frames", "80", "--seed", "3")
    truth = json.loads((tmp_path / "v2" / "changes.json").read_text())["changes"]
    assert "chair" in [change["name"] for change in truth if change["kind"] == "added"]
    succeed("run", tmp_path / "v1", "--out", tmp_path / "one", *RUN)
    succeed("run", tmp_path / "v2", "--out", tmp_path / "two", "--map", tmp_path / "one", *RUN)

    store = tmp_path / "map.grid"
    succeed("submaps", tmp_path / "one", "--out", store, "--visit", "one")
    early = succeed("submaps", tmp_path / "two", "--out", store, "--visit", "two")
    assert "added, and not in the store yet, for no cell of the new one was due" in " ".join(early.split())
    assert chair_of(store)["gaussians"] == 0

    late = succeed("submaps", tmp_path / "two", "--out", store, "--visit", "two", "--at", "1000")
    assert "not in the store yet" not in " ".join(late.split())
    chair = chair_of(store)
    assert chair["gaussians"] > 500 and chair["first_seen"] == "two"
    since = json.loads(succeed("submaps", store, "--since", "two", "--json"))
    told = [(e["kind"], e["name"]) for e in since["events"] if e["kind"] != "unseen"]
    assert ("added", "chair") in told and set(told) <= {(change["kind"], change["name"]) for change in truth}
    # The mug moved, and has 40 pixels at most: if that is not told, nothing is claimed of it.
    unseen = [e["name"] for e in since["events"] if e["kind"] == "unseen"]
    assert ("moved", "mug") in told or "mug" in unseen


def chair_of(store: Path) -> dict:
    objects = json.loads((store / "objects.json").read_text())["objects"]
    return next(o for o in objects if o["name"] == "chair" and o["first_seen"] == "two")
