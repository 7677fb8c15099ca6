"""Parts of the page's program under Node: addresses of views, and the resolution while the camera moves."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from typing import Any

import pytest
from chromium import bench_page, needs_node

Json = dict[str, Any]
pytestmark = needs_node


@pytest.fixture(scope="module")
def parts_of_page(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Json]:
    program = bench_page.bundled("page.ts", tmp_path_factory.mktemp("node") / "page.mjs", "--platform=node")

    def run(**task: Any) -> Json:
        words = json.dumps({"addresses": [], "stops": 3, "places": [], "frames": []} | task)
        found = subprocess.run(["node", program, words], check=True, capture_output=True, text=True)
        return dict(json.loads(found.stdout))

    return run


def test_addresses_name_views(parts_of_page: Callable[..., Json]) -> None:
    place = {"position": [1.5, -2e-7, 300.0], "ahead": [0.0, 1.0, -4.25], "lens": 1}
    links = parts_of_page(places=[[2, place], [None, place]])["links"]
    assert links == ["#camera=3", "#camera=1.5,-2e-7,300,0,1,-4.25,2"]
    cameras = parts_of_page(addresses=[*links, links[1].replace(",", "%2C")])["views"]
    assert cameras == [2, place, place]


HOSTILE = ["", "#", "#other=1", "#camera=" + "1," * 10_000 + "1"] + [
    f"#camera={value}"
    for value in (
        " 0 4 -1 1.5 1e99 NaN , 1,2,3,0,0,1 1,2,3,0,0,1,9 1,2,3,0,0,0,1 1,2,1e300,0,0,1,1 1,,3,0,0,1,1 "
        "1,2,3,0,0,1,1,1 Infinity,2,3,0,0,1,1 0x1 __proto__ % <script>"
    ).split(" ")
]
"""Addresses that name no view."""


def test_hostile_addresses_name_none(parts_of_page: Callable[..., Json]) -> None:
    assert parts_of_page(addresses=HOSTILE)["views"] == [None] * len(HOSTILE)


@pytest.mark.parametrize("cost", [20, 45, 100, 300, 5000])
def test_the_resolution_follows_the_time_of_a_frame(cost: int, parts_of_page: Callable[..., Json]) -> None:
    shares = parts_of_page(frames=[[cost, 2]] * 40)["shares"]
    assert shares[0] == 1
    # It rests at the largest of its steps that has thirty frames a second, or at a quarter.
    assert len(set(shares[20:])) == 1
    assert cost * shares[-1] ** 2 + 2 < 36 or shares[-1] == 0.25
    assert cost * shares[-1] ** 2 * 2 + 2 > 30 or shares[-1] == 1
    # It grows again once frames are cheap.
    assert parts_of_page(frames=[[cost, 2]] * 20 + [[1, 1]] * 40)["shares"][-1] == 1
