"""The web page of a packed scene: what Python writes, the page's decoder against Python's, and parts of its program."""

import base64
import html
import io
import json
import logging
import re
import subprocess
from dataclasses import replace
from functools import partial
from pathlib import Path

import fuzz_packs
import numpy as np
import pytest
import torch
from chromium import CHROMIUM, bench_page, browser, needs_chromium, needs_node
from command_line import run
from documents import put
from packed_scenes import KINDS, header_and_body, packed_file, resealed, sealed, write_bomb, write_kind
from PIL import Image

import sundae_ns as sn
from sundae_ns.core.errors import PackError
from sundae_ns.io.pack.packed_scene import read_scene
from sundae_ns.rasterize.reference import project
from sundae_ns.scene import page as page_module
from sundae_ns.scene.packing import scene_of
from sundae_ns.scene.page import packed_of, page_of, write_page
from sundae_ns.scene.render import pass_inputs

ROOT = Path(__file__).parents[2]
WEB = ROOT / "web"


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    return write_kind(tmp_path_factory.mktemp("scenes") / "a.sundae", KINDS["residual"])


@pytest.fixture(scope="module")
def scene(packed):
    return sn.load(packed)


def test_a_page_holds_the_scene_and_no_address(packed, tmp_path):
    out = tmp_path / "a.html"
    assert write_page(out, ("a <b> & c", *packed_file(packed))) == out.stat().st_size
    page = out.read_text()
    (scene,) = re.findall(r'<script type="application/octet-stream"[^>]*>([^<]*)</script>', page)
    assert base64.b64decode(scene, validate=True) == packed.read_bytes()
    assert "<title>a &lt;b&gt; &amp; c</title>" in page
    assert "@@" not in page
    # The namespace of XHTML is a name, which nothing loads.
    assert set(re.findall(r"https?://[\w./]*", page)) <= {"http://www.w3.org/1999/xhtml"}
    assert "default-src 'none'" in page


def test_a_page_shows_its_first_view_until_it_draws(scene):
    for shown in (scene, replace(scene, start=scene.cameras[1].zoomed(0.5))):
        (code,) = re.findall(r'src="data:image/jpeg;base64,([^"]*)"', page_of(("a", shown, b"")))
        found = np.asarray(Image.open(io.BytesIO(base64.b64decode(code))), dtype=np.float32)
        truth = 255 * sn.render(shown, shown.start or shown.cameras[0]).rgb.numpy()
        assert found.shape == truth.shape
        assert np.abs(found - truth).mean() < 6  # JPEG


def test_a_page_of_too_many_primitives_has_no_first_image(tmp_path, capsys, caplog):
    bomb = write_bomb(tmp_path / "a.sundae")
    assert bomb.stat().st_size < 100_000
    assert run("export", bomb, "-o", tmp_path / "a.html") == 0
    (line,) = caplog.messages
    assert "the page has no first image: " in line
    page = (tmp_path / "a.html").read_text()
    assert "image/jpeg" not in page
    (code,) = re.findall(r'src="data:image/gif;base64,([^"]*)"', page)
    assert Image.open(io.BytesIO(base64.b64decode(code))).convert("RGBA").getpixel((0, 0))[3] == 0
    # An image is refused, and its other view is rendered.
    for camera in (0, 1):
        assert run("render", bomb, "-o", tmp_path / "a.png", "--view", camera) == (0 if camera else 2)
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "Gaussians in each tile of its image" in err


def test_a_folder_has_page_and_scene_apart(packed, tmp_path):
    out = tmp_path / "site"
    assert write_page(out, ("a", *packed_file(packed))) == sum(path.stat().st_size for path in out.iterdir())
    assert (out / "scene.sundae").read_bytes() == packed.read_bytes()
    assert 'data-source="scene.sundae"></script>' in (out / "index.html").read_text()
    write_page(out, ("a", *packed_file(packed)))


def test_a_page_of_two_scenes_with_named_views(packed, scene, tmp_path):
    views = {"a </script>": 1, "b": scene.cameras[0], "c": "http://x/#camera=2"}
    sn.page({"one": scene, "two": scene[::2]}, tmp_path / "both", views=views)
    index = (tmp_path / "both" / "index.html").read_text()
    found = dict(re.findall(r'data-name="(\w+)" data-source="([\w.]+)"', index))
    assert found == {"one": "scene.sundae", "two": "scene1.sundae"}
    assert sn.load(tmp_path / "both" / "scene1.sundae").num_gaussians == len(scene[::2])
    (named,) = re.findall(r'id="named">(.*?)</script>', index)
    links = dict(json.loads(named))
    assert [links["a </script>"], links["c"]] == ["#camera=2"] * 2
    *center, x, y, z, lens = map(float, links["b"].removeprefix("#camera=").split(","))
    np.testing.assert_allclose(center, scene.cameras[0].center, rtol=1e-5)
    assert np.dot([x, y, z], -scene.cameras[0].pose[:, 2].numpy()) == pytest.approx(np.linalg.norm([x, y, z]))
    assert run("export", packed, packed, "-o", tmp_path / "a.html", "--views", "Front=#camera=1") == 0
    assert "<title>a | a</title>" in (tmp_path / "a.html").read_text()


@needs_node
def test_the_page_is_built_from_its_sources(tmp_path):
    built = tmp_path / "page.html"
    subprocess.run(["node", "build.mjs", built], cwd=WEB, check=True)
    assert built.read_text() == (ROOT / "sundae_ns" / "scene" / "page.html").read_text(), "run make web"


@needs_node
def test_the_sources_pass_their_checks():
    for command in (["tsc"], ["biome", "ci", "."]):
        subprocess.run([WEB / "node_modules" / ".bin" / command[0], *command[1:]], cwd=WEB, check=True)


@pytest.fixture(scope="module")
def decode(tmp_path_factory):
    """The page's decoder under Node: a JSON object for each file."""
    program = tmp_path_factory.mktemp("node") / "dump.mjs"
    bundle = [WEB / "node_modules/.bin/esbuild", "tests/dump.ts", "--bundle", "--platform=node", "--format=esm"]
    subprocess.run([*bundle, "--log-level=error", f"--outfile={program}"], cwd=WEB, check=True)

    def run(*files):
        found = subprocess.run(["node", program, *files], check=True, capture_output=True, text=True)
        return [json.loads(line) for line in found.stdout.splitlines()]

    return run


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A packed scene of each kind."""
    folder = tmp_path_factory.mktemp("kinds")
    return [write_kind(folder / f"{i}.sundae", kind) for i, kind in enumerate(KINDS.values())]


@needs_node
def test_the_decoder_agrees_with_python(decode, files):
    for file, found, kind in zip(files, decode(*files), KINDS.values(), strict=True):
        truth = read_scene(file)
        assert found["count"] == len(truth.gaussians["means"])
        stated = (found["degree"], found["logits"], found["antialiased"])
        assert stated == (kind.degree, kind.degree == 0, kind.antialiased)
        assert found["extent"] == pytest.approx(sn.load(file).extent)
        for name, value in {**truth.gaussians, **truth.head}.items():
            array = np.fromfile(f"{file}.{name}", np.float32)
            # Sums of the transform and lengths of quaternions round in another order.
            exact = name == "means" or name in truth.head
            tolerance = {"rtol": 0.0, "atol": 2e-7} if name == "quats" else {"rtol": 2e-7, "atol": 1e-6}
            found_as = np.testing.assert_array_equal if exact else partial(np.testing.assert_allclose, **tolerance)
            found_as(array, value.numpy().reshape(-1), err_msg=name)
        poses = [camera["pose"] for camera in found["cameras"]]
        assert torch.equal(torch.tensor(poses).reshape(-1, 3, 4), truth.cameras["poses"])


def second_half_of_a_stream(sections):
    """Where it begins and ends, of the first section that is compressed."""
    lengths = [sum(entry["parts"]) for entry in sections]
    sizes = [np.prod(entry["shape"]) * np.dtype(entry["dtype"]).itemsize for entry in sections]
    i = next(i for i, (length, size) in enumerate(zip(lengths, sizes)) if length < size)
    return sum(lengths[:i]) + lengths[i] // 2, sum(lengths[: i + 1])


def with_lie(meta, path, value):
    """A header with another value. ``path`` is dotted keys; after a leading colon the first names a section."""
    lying = json.loads(json.dumps(meta))
    if path.startswith(":"):
        name, _, path = path[1:].partition(".")
        path = f"sections.{[entry['name'] for entry in meta['sections']].index(name)}.{path}"
    put(lying, {path.replace(".", "/"): value})
    return lying


POSE = [[1, 0, 0, 3], [0, 1, 0, 0], [0, 0, 1, 0]]
START = {"pose": POSE, "intrinsics": [9, 9, 0, 0], "size": [4, 3]}
LIES = [
    ("primitives", 10**9),
    ("primitives", 401),
    ("attributes.scales.codec", "pickle"),
    ("attributes.means.bits", 200),
    ("attributes.means.block", 0),
    (":opacities/levels.shape", [2**27, 2**27, 2**27]),
    (":opacities/levels.parts.0", -5),
    (":opacities/levels.parts.0", 2**50),
    (":opacities/levels.dtype", "|O"),
    (":means/low.name", "means/lower"),
    (":means/low.name", "means/high"),
    ("attributes.head.tensors.0.1", [2**27, 2**27]),
    ("attributes.head.tensors.1.0", "net.decoder.0.0.bias"),
    ("up", [0, 0, float("nan")]),
    ("up", [0, 0, 1e30]),
    ("start", {**START, "pose": [[0] * 4] * 3}),
    ("start", {**START, "pose": POSE[::-1]}),
    ("start", {**START, "pose": [[1, 0, 0, 1e30], *POSE[1:]]}),
    ("start", {**START, "size": [0, 3]}),
    ("model", None),
    *(("model.sh_degree", degree) for degree in (1, 10**6, True)),
    ("model.rasterize_mode", "os.system"),
    *(("model.background_color", color) for color in ("__proto__", ["white"])),
    *(("model.head", head) for head in (None, "residual", {"mode": "residual"})),
    ("model.head.mode", "off"),
    ("model.head._target", "os.system"),
    ("model.head.size", "compact"),
    ("model.head.num_features", 4),
    ("model.head.pixel_unshuffle", 2),
    *(("model.trained_focal", focal) for focal in ([0, 1], [-1.0, 2.0], [1.0])),
    ("source", []),
]
"""Places in the header, and values that no packed scene has there."""


@pytest.fixture
def refused(packed, tmp_path):
    """Files that Python refuses, by what is wrong with them."""
    good = packed.read_bytes()
    meta, body = header_and_body(good)
    files = {"truncated": good[:-1], "longer": good + b"x", "empty": b"", "another file": b"ply\n" + good[4:]}
    files |= {"cut in its header": good[:100], "another version": good[:8] + b"\x02" + good[9:]}
    files |= {"an altered header": good[:60] + b"~" + good[61:], "an altered section": good[:-1] + b"~"}
    files |= {f"{path} {value}": sealed(with_lie(meta, path, value), body) for path, value in LIES}
    middle, end = second_half_of_a_stream(meta["sections"])
    files["a broken stream, under a valid checksum"] = resealed(meta, body[:middle] + bytes(end - middle) + body[end:])
    paths = {name: tmp_path / f"{i}.sundae" for i, name in enumerate(files)}
    for name, path in paths.items():
        path.write_bytes(files[name])
        with pytest.raises(PackError):
            scene_of(read_scene(path))
    return paths


def test_python_refuses_files_that_lie(refused):
    assert len(refused) > len(LIES) > 30


@needs_node
def test_the_decoder_refuses_what_python_refuses(decode, refused):
    for name, found in zip(refused, decode(*refused.values()), strict=True):
        assert "error" in found, name
        assert re.fullmatch(r"The [^\n]{10,200}\.", found["error"]), found


@needs_node
def test_the_page_counts_fragments_before_it_draws(files, tmp_path):
    """Without WebGPU; the sums of the quads' rectangles, by Python's projection."""
    files = [*files[::2], write_bomb(tmp_path / "bomb.sundae", 30_000)]
    program = bench_page.bundled("overdraw.ts", tmp_path / "overdraw.mjs", "--platform=node")
    found = subprocess.run(["node", program, *files], check=True, capture_output=True, text=True)
    for file, line in zip(files, found.stdout.splitlines(), strict=True):
        counted, scene = json.loads(line), sn.load(file)
        camera, opacities = scene.cameras[0], scene.opacities
        splats = project(pass_inputs(scene.gaussians, camera, scene.settings()))
        reach = (2 * (255 * opacities).log()).clamp(min=0).sqrt().clamp(max=3.4)[:, None]
        reach = reach * splats.covars2d[:, [0, 2]].sqrt()
        low = (splats.means2d - reach).clamp(min=0)
        high = torch.minimum(splats.means2d + reach, torch.tensor((camera.width, camera.height)))
        visible = (splats.depths >= scene.settings().near_plane) & (opacities >= 1 / 255)
        areas = (high - low).clamp(min=0).prod(dim=1) * visible
        assert counted["fragments"] == pytest.approx(float(areas.double().sum()), rel=1e-3)
        assert counted["bound"] >= counted["fragments"]
        assert (counted["fragments"] > 256 * counted["most"]) == (file == files[-1])


@needs_node
def test_a_phone_draws_what_covers_most(decode, tmp_path, monkeypatch):
    monkeypatch.setenv("MOST", "20")
    file = write_kind(tmp_path / "a.sundae", KINDS["residual"])
    (found,), scene = decode(file), sn.load(file)
    assert (found["count"], found["total"]) == (20, len(scene))
    rows = (scene.opacities * scene.scales.sort(dim=1).values[:, 1:].prod(dim=1)).topk(20).indices.sort().values
    for name in ("means", "features"):
        drawn = np.fromfile(f"{file}.{name}", np.float32).reshape(20, -1)
        np.testing.assert_allclose(drawn, scene.gaussians[name][rows], atol=1e-6)


@needs_node
def test_both_readers_give_the_same_verdicts():
    """A short version of ``python benchmarks/fuzz_packs.py``, from another seed."""
    tally, problems = fuzz_packs.run(100, seed=1_000_000)
    assert not problems
    assert min(tally["valid"], tally["refused"]) > 10


HOSTILE = """"></iframe><script>alert('&amp;')</script><b x='"""


def frame_of(text):
    """Attributes of the one element of a fragment, an ``iframe``."""
    ((attributes,),) = [re.findall(r"<iframe ([^<>]*)></iframe>", text)]
    assert text == f"<iframe {attributes}></iframe>"
    return {name: html.unescape(value) for name, value in re.findall(r'([\w-]+)="([^"]*)"', attributes)}


def test_the_page_in_the_frame_holds_the_scene(scene):
    frame = frame_of(sn.show(scene, height=321)._repr_html_())
    assert (frame["height"], frame["width"]) == ("321", "100%")
    assert frame["srcdoc"] == page_of(("Scene", scene, packed_of(scene)))


def test_a_hostile_title_stays_text(scene):
    frame = frame_of(sn.show(scene, title=HOSTILE)._repr_html_())
    assert frame["title"] == HOSTILE
    plain = frame_of(sn.show(scene, title="plain")._repr_html_())
    assert frame["srcdoc"].replace(re.findall("<title>(.*)</title>", frame["srcdoc"])[0], "plain") == plain["srcdoc"]
    assert set(frame) == set(plain) == {"srcdoc", "title", "width", "height", "style", "allow"}


def test_a_large_page_is_shown_with_a_warning(scene, monkeypatch, caplog):
    caplog.set_level(logging.WARNING)
    assert sn.show(scene).page
    assert caplog.text == ""
    monkeypatch.setattr(page_module, "LARGE", 100_000)
    shown = sn.show(scene)
    assert frame_of(shown._repr_html_())["srcdoc"] == shown.page
    assert re.search(r"a page of 0\.[2-9] MB; prune it, or save it as scene.html", caplog.text)


@pytest.mark.browser
@needs_chromium
def test_a_browser_renders_the_scene_in_the_frame(scene, tmp_path):
    (tmp_path / "a.html").write_text(f"<body style='margin: 0'>{sn.show(scene, height=120)._repr_html_()}")
    with browser.Browser(CHROMIUM, 160, 120, browser.WEBGPU) as page:
        page.open((tmp_path / "a.html").as_uri())
        inside = "document.querySelector('iframe')?.contentWindow.sundae"
        browser.wait_for(lambda: page.evaluate(f"({inside}?.state ?? 'loading') !== 'loading'"), "the page", 180)
        assert page.evaluate(f"{inside}.state") == "ready", page.evaluate(f"{inside}.message")
        browser.wait_for(lambda: page.evaluate(f"{inside}.still"), "the image at rest", 180)
        assert page.errors == []


@pytest.fixture(scope="module")
def parts_of_page(tmp_path_factory):
    program = bench_page.bundled("page.ts", tmp_path_factory.mktemp("node") / "page.mjs", "--platform=node")

    def run(**task):
        words = json.dumps({"addresses": [], "stops": 3, "places": [], "frames": []} | task)
        found = subprocess.run(["node", program, words], check=True, capture_output=True, text=True)
        return dict(json.loads(found.stdout))

    return run


@needs_node
def test_addresses_name_views_or_none(parts_of_page):
    place = {"position": [1.5, -2e-7, 300.0], "ahead": [0.0, 1.0, -4.25], "lens": 1}
    links = parts_of_page(places=[[2, place], [None, place]])["links"]
    assert links == ["#camera=3", "#camera=1.5,-2e-7,300,0,1,-4.25,2"]
    hostile = [None] * len(HOSTILE_ADDRESSES)
    cameras = parts_of_page(addresses=[*links, links[1].replace(",", "%2C"), *HOSTILE_ADDRESSES])["views"]
    assert cameras == [2, place, place, *hostile]


HOSTILE_ADDRESSES = ["", "#", "#other=1", "#camera=" + "1," * 10_000 + "1"] + [
    f"#camera={value}"
    for value in (
        " 0 4 -1 1.5 1e99 NaN , 1,2,3,0,0,1 1,2,3,0,0,1,9 1,2,3,0,0,0,1 1,2,1e300,0,0,1,1 1,,3,0,0,1,1 "
        "1,2,3,0,0,1,1,1 Infinity,2,3,0,0,1,1 0x1 __proto__ % <script>"
    ).split(" ")
]
"""Addresses that name no view."""


@needs_node
@pytest.mark.parametrize("cost", [20, 45, 100, 300, 5000])
def test_the_resolution_follows_the_time_of_a_frame(cost, parts_of_page):
    shares = parts_of_page(frames=[[cost, 2]] * 40)["shares"]
    assert shares[0] == 1
    # It rests at the largest of its steps that has thirty frames a second, or at a quarter.
    assert len(set(shares[20:])) == 1
    assert cost * shares[-1] ** 2 + 2 < 36 or shares[-1] == 0.25
    assert cost * shares[-1] ** 2 * 2 + 2 > 30 or shares[-1] == 1
    # It grows again once frames are cheap.
    assert parts_of_page(frames=[[cost, 2]] * 20 + [[1, 1]] * 40)["shares"][-1] == 1
