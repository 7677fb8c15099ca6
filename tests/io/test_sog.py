"""Files of .sog, decoded by the format's public description."""

import io
import json
import math
import zipfile

import numpy as np
import pytest
import torch
from documents import GONE, put
from fields import assert_close
from foreign_files import small_field
from hypothesis import given
from hypothesis import strategies as st
from limits import refused
from PIL import Image

import sundae_ns as sn
from sundae_ns.io.coordinates import scene_order
from sundae_ns.io.formats import read_gaussian_file
from sundae_ns.io.ply import Marks
from sundae_ns.io.sog import codebook, kmeans, palette, write_sog, write_streamed


def gaussians(n=150, degree=3):
    field = small_field(n, degree)
    field["opacities"][:3] = -20  # level 0: colours must survive
    return field


def entries(path):
    with zipfile.ZipFile(path) as bundle:
        return {name: bundle.read(name) for name in bundle.namelist()}


def read(path):
    """``meta.json``, and the Gaussians as sections 3.1 to 3.5 of the description decode them."""
    files = entries(path)
    meta = json.loads(files["meta.json"])
    n = meta["count"]

    def image(entry, number=0):
        return np.asarray(Image.open(io.BytesIO(files[meta[entry]["files"][number]])).convert("RGBA"), dtype=np.int64)

    def pixels(entry, number=0):
        return image(entry, number).reshape(-1, 4)[:n]

    low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    bent = low + (high - low) * (pixels("means") + 256 * pixels("means", 1))[:, :3] / 65535
    quats, colors = pixels("quats"), pixels("sh0")
    three = (quats[:, :3] / 255 - 0.5) * 2 / math.sqrt(2)
    largest = np.sqrt(1 - (three**2).sum(axis=1))
    found = {
        "means": np.sign(bent) * np.expm1(np.abs(bent)),
        "quats": np.array([np.insert(three[i], quats[i, 3] - 252, largest[i]) for i in range(n)]),
        "scales": np.array(meta["scales"]["codebook"])[pixels("scales")[:, :3]],
        "features_dc": np.array(meta["sh0"]["codebook"])[colors[:, :3]],
        "alphas": colors[:, 3:] / 255,
    }
    if "shN" in meta:
        count = (meta["shN"]["bands"] + 1) ** 2 - 1
        index = pixels("shN", 1) @ [1, 256, 0, 0]
        assert index.max() < meta["shN"]["count"]
        assert (rows := image("shN")).shape[1] == 64 * count
        column = (index % 64)[:, None] * count + np.arange(count)
        found["features_rest"] = np.array(meta["shN"]["codebook"])[rows[(index // 64)[:, None], column, :3]]
    return meta, found


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_values_come_back(tmp_path, degree):
    truth = gaussians(degree=degree)
    write_sog(tmp_path / "a.sog", truth)
    meta, found = read(tmp_path / "a.sog")
    assert (meta["version"], meta["count"]) == (2, 150)
    assert all(len(meta[name]["codebook"]) == 256 for name in ("scales", "sh0", *(["shN"] if degree else [])))
    order, _ = scene_order(truth["means"].numpy())
    truth = {name: value[torch.from_numpy(order)] for name, value in truth.items()}
    # Half a level of an axis, times the largest slope of the inverse.
    step = (np.array(meta["means"]["maxs"]) - meta["means"]["mins"]) / 65535
    assert (np.abs(found["means"] - truth["means"].numpy()) <= step / 2 * 3 + 1e-6).all()
    assert np.abs(found["alphas"] - truth["opacities"].sigmoid().numpy()).max() <= 0.5 / 255 + 1e-6
    quats = torch.nn.functional.normalize(truth["quats"], dim=1).numpy()
    assert np.abs((found["quats"] * quats).sum(axis=1)).min() >= 1 - 6 * (0.5 / 255) ** 2
    for name in ("scales", "features_dc"):
        # 256 codebook entries for 450 values.
        assert np.abs(found[name] - truth[name].numpy()).max() < 0.05, name
    if degree:
        assert np.abs(found["features_rest"] - truth["features_rest"].numpy()).max() < 0.01


@pytest.mark.parametrize("n", [1, 2, 64, 65])
def test_few_equal_primitives(tmp_path, n):
    truth = {name: value[:1].expand(n, *value.shape[1:]) for name, value in gaussians().items()}
    write_sog(tmp_path / "a.sog", truth)
    _, found = read(tmp_path / "a.sog")
    for name in ("means", "scales", "features_dc", "features_rest"):
        assert found[name].shape == truth[name].shape
        assert np.allclose(found[name], truth[name].numpy(), atol=1e-4), name


@given(st.lists(st.floats(-1e6, 1e6, width=32), min_size=1, max_size=600))
def test_codes_index_the_nearest_number(values):
    given_values = np.array(values, np.float32)
    numbers, codes = codebook(given_values)
    assert numbers.shape == (256,)
    assert (np.diff(numbers) >= 0).all()
    distance = np.abs(given_values[:, None].astype(np.float64) - numbers)
    assert (distance[np.arange(len(values)), codes] <= distance.min(axis=1) + 1e-6 * np.abs(given_values).max()).all()


def test_the_codebook_is_better_than_equal_steps():
    values = np.random.default_rng(0).laplace(size=20_000).astype(np.float32)
    numbers, codes = codebook(values)
    step = np.ptp(values) / 255
    equal = np.rint((values - values.min()) / step) * step + values.min()
    assert ((numbers[codes] - values) ** 2).mean() < 0.5 * ((equal - values) ** 2).mean()


def test_a_palette_of_two_levels():
    generator = np.random.default_rng(0)
    centres = generator.normal(size=(40, 9)).astype(np.float32)
    rows = centres[generator.integers(40, size=3000)] + 0.01 * generator.normal(size=(3000, 9)).astype(np.float32)
    found, labels = palette(rows, 600)
    assert len(found) <= 600
    assert labels.max() < len(found)
    # 600 rows for 40 clusters with noise 0.01; a single row would have an error of 1.
    assert np.sqrt(((found[labels] - rows) ** 2).mean()) < 0.011
    same, each = palette(rows, 3000)
    assert np.array_equal(same[each], rows)
    equal = torch.full((50, 2), 3.0).double()  # a centre without rows is unchanged
    assert torch.equal(kmeans(equal, 4, torch.Generator().manual_seed(0)), equal[:4])


def zipped(content, method=zipfile.ZIP_STORED):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as bundle:
        for name, data in content.items():
            bundle.writestr(name, data)
    return out.getvalue()


@pytest.fixture(scope="module")
def bundled(tmp_path_factory):
    path = tmp_path_factory.mktemp("sog") / "a.sog"
    write_sog(path, gaussians())
    return entries(path)


FORMS = {
    "in a folder": lambda files: zipped({f"garden/{name}": data for name, data in files.items()}),
    "by Windows": lambda files: zipped({f"garden\\{name}": data for name, data in files.items()}),
    "deflated": lambda files: zipped(files, zipfile.ZIP_DEFLATED),
    "in a zip": lambda files: zipped({"readme.txt": b"", "__MACOSX/._a.sog": b"", "b/a.SOG": zipped(files)}),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("suffix", [".sog", ".zip"])
def test_other_forms_of_a_bundle(tmp_path, bundled, form, suffix):
    (tmp_path / "a.sog").write_bytes(zipped(bundled))
    (tmp_path / f"b{suffix}").write_bytes(FORMS[form](bundled))
    truth, found = (read_gaussian_file(tmp_path / name)[0].gaussians for name in ("a.sog", f"b{suffix}"))
    assert all(torch.equal(found[name], truth[name]) for name in truth)


def test_survey_coordinates_are_read_in_double(tmp_path, bundled):
    """In float32 they have steps of a quarter there."""
    low, high = (np.log1p(np.array([end, end, end])).tolist() for end in (4e6, 4e6 + 10))
    files = ["means_l.webp", "means_u.webp"]
    (tmp_path / "a.sog").write_bytes(_meta(means={"mins": low, "maxs": high, "files": files})(bundled))
    means = read_gaussian_file(tmp_path / "a.sog")[0].gaussians["means"]
    assert len(means[:, 0].unique()) > 140
    assert np.ptp(means[:, 0].numpy()) == pytest.approx(10, abs=0.01)


def webp(width, height, **options):
    image = io.BytesIO()
    Image.new("RGBA", (width, height), (1, 2, 3, 252)).save(image, "WEBP", **options)
    return image.getvalue()


def _lie(content, name, size):
    """A bundle that states another size of an entry."""
    data = bytearray(content)
    for mark, at, header in ((b"PK\x03\x04", 22, 30), (b"PK\x01\x02", 24, 46)):
        start = -1
        while (start := data.find(mark, start + 1)) >= 0:
            if data[start + header : start + header + len(name)] == name:
                data[start + at : start + at + 4] = size.to_bytes(4, "little")
    return bytes(data)


def _meta(**changes):
    def make(files):
        document = json.loads(files["meta.json"])
        put(document, changes)
        return zipped(files | {"meta.json": json.dumps(document).encode()})

    return make


@pytest.mark.parametrize(("name", "value", "marked"), [("model", "mip", True), ("antialias", "false", False)])
def test_marks_of_antialiasing(tmp_path, bundled, name, value, marked):
    (tmp_path / "a.sog").write_bytes(_meta(**{name: value})(bundled))
    assert read_gaussian_file(tmp_path / "a.sog")[1].antialiased == marked


def _with(name, content):
    return lambda files: zipped(files | {name: content})


def _bomb(method):
    return lambda files: _lie(zipped({**files, "means_l.webp": bytes(1 << 20)}, method), b"means_l.webp", 1000)


def _all(side, **changes):
    """All images but those of harmonics are equal ones of these sides."""
    names = ("means_l.webp", "means_u.webp", "scales.webp", "quats.webp", "sh0.webp")
    return lambda files: _meta(**changes)(files | dict.fromkeys(names, webp(side, side, lossless=True)))


def _streamed(*leaves, chunks=1, more=None, **changes):
    """Levels of detail with these leaves, whose chunks in turn are copies of one."""

    def make(files):
        lods = [{"file": i % chunks, "offset": start, "count": count} for i, (start, count) in enumerate(leaves)]
        meta = {"tree": {"children": [{"lods": {"0": each}} for each in lods]}} if leaves else {}
        meta |= {"filenames": [f"{i}/meta.json" for i in range(chunks)], **changes}
        copies = {f"{i}/{name}": data for i in range(chunks) for name, data in files.items()}
        return zipped({"lod-meta.json": json.dumps(meta).encode(), **copies, **(more or {})})

    return make


def _many_chunks(files):
    chunk = _all(650, shN=GONE, count=422_500)(files)
    return _streamed(*[(0, 422_500)] * 9, chunks=9)(entries(io.BytesIO(chunk)))


SCALES, MEANS = ["scales.webp"], ["means_l.webp", "means_u.webp"]
HOSTILE = {
    "a lossy image": (_with("means_l.webp", webp(13, 13, quality=80)), "no lossless WebP"),
    "lossy colours beside alphas": (_with("sh0.webp", webp(13, 13, quality=80, alpha_quality=50)), "no lossless WebP"),
    "no image": (_with("means_l.webp", b"RIFF"), "no lossless WebP"),
    "an image beyond its Gaussians": (_all(900), "900 x 900 pixels for 150"),
    "as many Gaussians as pixels": (_all(3000, count=9_000_000), "would unpack to"),
    "more Gaussians than pixels": (_all(9), "fewer than 150 pixels"),
    "bz2": (_bomb(zipfile.ZIP_BZIP2), "compressed by method 12"),
    "deflate": (_bomb(zipfile.ZIP_DEFLATED), "CRC-32"),
    "a size beyond the file": (lambda files: _lie(zipped(files), b"means_l.webp", 2**32 - 2), "would unpack to"),
    "three levels": (lambda files: zipped({"a.sog": zipped({"b.sog": zipped(files)})}), "0 meta.json and 1 .sog"),
    "two scenes": (lambda files: zipped({"a.sog": zipped(files), "b.sog": b""}), "2 .sog, .*; .*or unzip it"),
    "streamed, without a tree": (_streamed(), "'tree'"),
    "another version of levels": (_streamed((0, 150), version=2), "has version 2 of streamed SOG"),
    "leaves that share Gaussians": (_streamed((0, 100), (99, 51)), "leaves share Gaussians of 0/meta.json"),
    "a leaf beyond its chunk": (_streamed((100, 51)), "leaves share Gaussians of 0/meta.json, or it has fewer"),
    "a negative leaf": (_streamed((-50, 50)), "leaves share Gaussians of 0/meta.json"),
    "a chunk from the end": (_streamed((0, 150), tree={"lods": {"0": {"file": -1, "offset": 0, "count": 150}}}), "-1"),
    "no chunk": (_streamed((0, 150), environment=None, filenames=["1/meta.json"]), "no item named .1/meta.json"),
    "many chunks of few bytes": (_many_chunks, "would unpack to"),
    "deep JSON": (_with("meta.json", b"[" * 999_999), "recursion"),
    "fewer than no Gaussians": (_meta(count=-5), "it states -5 Gaussians"),
    "half a Gaussian": (_meta(count=100.5), "count is no whole number"),
    "one bound for all axes": (_meta(means={"mins": [0.0], "maxs": [1.0], "files": MEANS}), "three numbers each"),
    "endless Gaussians": (_meta(count=math.inf), "infinity"),
    "an outside file": (_meta(quats={"files": ["../../etc/passwd"]}), "no item named"),
    "a short codebook": (_meta(scales={"codebook": [0.0], "files": SCALES}), "out of bounds"),
    "a codebook of pairs": (_meta(scales={"codebook": [[0.0, 1.0]] * 256, "files": SCALES}), "scales has shape"),
    "NaN for a bound": (_meta(means={"mins": [math.nan] * 3, "maxs": [1] * 3, "files": MEANS}), "none is finite"),
    "the first version": (_meta(version=GONE), "has version 1, not 2; convert .*, gsplat's folder to"),
    "another SH degree": (_meta(**{"shN/bands": 1}), "cannot reshape"),
    "no SH degree": (_meta(shN={"bands": 9, "codebook": [0], "files": []}), "99 SH coefficients"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_bundles(tmp_path, bundled, kind):
    make, words = HOSTILE[kind]
    (tmp_path / "a.sog").write_bytes(make(bundled))
    refused(read_gaussian_file, tmp_path / "a.sog", words)


def test_a_folder_is_read_as_its_bundle(tmp_path, bundled):
    """So splat-transform and SuperSplat write it for a web page."""
    (tmp_path / "a.sog").write_bytes(zipped(bundled))
    zipfile.ZipFile(io.BytesIO(zipped(bundled))).extractall(folder := tmp_path / "a")
    whole = read_gaussian_file(tmp_path / "a.sog")[0].gaussians
    for path in (folder, folder / "meta.json"):
        assert_close(sn.load(path).gaussians, whole, {"quats": 1e-6, "opacities": 1e-6})


@pytest.mark.parametrize(("file", "words"), [("../x.webp", "or lies elsewhere"), ("gone.webp", "gone.webp is missing")])
def test_a_folder_has_all_its_files(tmp_path, bundled, file, words):
    zipfile.ZipFile(io.BytesIO(_meta(**{"scales/files": [file]})(bundled))).extractall(tmp_path)
    refused(read_gaussian_file, tmp_path / "meta.json", words)


def leaves_of(node):
    return [leaf for child in node["children"] for leaf in leaves_of(child)] if "children" in node else [node]


def test_levels_of_detail(tmp_path, monkeypatch):
    monkeypatch.setattr("sundae_ns.io.sog._LEAF", 20)
    monkeypatch.setattr("sundae_ns.io.sog._CHUNK", 50)
    levels = [gaussians(n, degree=1) for n in (150, 70, 4)]
    write_streamed(tmp_path, levels, Marks(True, up=(0.0, 0.6, 0.8), offset=(4e6 + 1 / 3, 0.0, -7.0)))
    meta = json.loads((tmp_path / "lod-meta.json").read_text())
    assert (meta["version"], meta["count"], meta["counts"], meta["lodLevels"]) == (1, 224, [150, 70, 4], 3)
    chunks = [read_gaussian_file(tmp_path / name)[0].gaussians for name in meta["filenames"]]
    ends = [0] * len(chunks)
    for leaf in leaves_of(meta["tree"]):
        assert leaf["lods"]["0"]["count"] <= 20
        for level, rows in leaf["lods"].items():
            assert meta["filenames"][rows["file"]].startswith(f"{level}_")
            assert rows["offset"] == ends[rows["file"]]
            ends[rows["file"]] += rows["count"]
            held = {name: value[rows["offset"] :][: rows["count"]] for name, value in chunks[rows["file"]].items()}
            reach = 3 * held["scales"].exp().amin(dim=1, keepdim=True) - 1e-3  # it holds the ball in each ellipsoid
            low, high = (torch.tensor(leaf["bound"][end]) for end in ("min", "max"))
            assert ((held["means"] - reach >= low) & (held["means"] + reach <= high)).all()
    assert ends == [len(chunk["means"]) for chunk in chunks]
    assert len(ends) > 5
    for path in (tmp_path, tmp_path / "lod-meta.json"):
        found, marks = read_gaussian_file(path)
        assert marks == Marks(True, up=(0.0, 0.6, 0.8), offset=(4e6 + 1 / 3, 0.0, -7.0))
        assert torch.cdist(levels[0]["means"], found.gaussians["means"]).amin(dim=1).max() < 1e-3
        assert found.gaussians.num_gaussians == 150
    (tmp_path / "lod-meta.json").write_text(json.dumps(meta).replace('"0_0', '"../a/0_0'))
    refused(read_gaussian_file, tmp_path, "lies elsewhere")
    (tmp_path / "0_0-notes").mkdir()
    write_streamed(tmp_path, [gaussians(9, degree=0)])  # replaces the others
    chunk = json.loads((tmp_path / "lod-meta.json").read_text())["filenames"][0].split("/")[0]
    assert {path.name for path in tmp_path.iterdir()} == {chunk, "0_0-notes", "lod-meta.json"}


def test_a_zip_with_an_environment(tmp_path, bundled):
    """It belongs to every level, and may have fewer harmonics."""
    write_sog(tmp_path / "sky.sog", gaussians(30, degree=0), Marks(True))
    sky = {f"env/{name}": data for name, data in entries(tmp_path / "sky.sog").items()}
    make = _streamed((0, 50), (50, 60), more=sky, environment="env/meta.json", version="1")
    (tmp_path / "a.zip").write_bytes(make(bundled))
    found, marks = read_gaussian_file(tmp_path / "a.zip")
    assert (found.gaussians["features_rest"].shape, marks.antialiased) == ((140, 15, 3), False)
    assert not found.gaussians["features_rest"][110:].any()
