"""Bad captures, loaded by the datamanager of training: transforms.json, COLMAP models, images; and unusual ones."""

import itertools
import json
import os
import shutil
import struct
import zlib
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from colmap_models import write_model
from damage import damage
from documents import GONE, put
from hypothesis import HealthCheck, given, settings
from icc_profiles import judged, profile
from limits import refused, verdict
from models import _build
from photos import photo
from PIL import Image
from small_captures import HEIGHT, SIZE, WIDTH, bytes_of, load, manager, meta_of, write_text_model

from sundae_ns.core.errors import DataError
from sundae_ns.data.colmap import check_colmap


def rewrite(data, changes, begin=b""):
    meta = meta_of(data)
    put(meta, changes)
    (data / "transforms.json").write_bytes(begin + json.dumps(meta).encode())


def as_text(data):
    shutil.rmtree(data / "sparse")
    write_text_model(data / "sparse" / "0", sorted(path.name for path in (data / "images").iterdir()))


FILES = [f"sparse/0/{name}.{kind}" for name in ("cameras", "images", "points3D") for kind in ("bin", "txt")]
FILES += ["transforms.json", "0.png", "0.jpg", "masks/half.png"]
many = settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])


@pytest.fixture(scope="module")
def warm(scene):
    """Load a capture once without limits: the first threads of a process reserve addresses that it keeps."""
    load(scene)


@pytest.mark.parametrize("file", FILES)
@many
@given(change=damage())
def test_damaged_files(warm, capture, file, change):
    path = capture / file
    if path.suffix == ".txt" and not path.exists():
        as_text(capture)
    elif file.startswith("masks") and not path.exists():
        _masked(capture)
    elif file.startswith("0") and not path.exists():
        old = meta_of(capture)["frames"][0]["file_path"]
        with Image.open(capture / old) as image:
            image.convert("RGB").save(path)
        (capture / "transforms.json").write_text((capture / "transforms.json").read_text().replace(old, file))
    content = path.read_bytes()
    path.write_bytes(change(content))
    try:
        verdict(lambda: load(capture, colmap=file.startswith("sparse")), bytes_of(capture))
    finally:  # for the next case, and for hypothesis to see the same again
        path.write_bytes(content)


VALUES = (
    *(None, True, "", "word", "0", [], {}, [[]], 0, -1, 0.5, 1e-300, 1e30, 1e308, float("nan"), float("inf")),
    *(10**400, [float("nan")] * 4, [[0.0] * 4] * 4, "../../x.png", "\0", "ünï cöde.png", [[1, 2], [3]]),
)


def places(value):
    keys = value.keys() if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    return [(value, key) for key in keys] + [place for key in keys for place in places(value[key])]


@many
@given(data=st.data(), value=st.sampled_from(VALUES) | st.just("gone"))
def test_damaged_values_of_transforms(capture, data, value):
    content = (capture / "transforms.json").read_text()
    meta = json.loads(content)
    holder, key = data.draw(st.sampled_from(places(meta)))
    holder[key] = value
    if value == "gone":
        del holder[key]
    (capture / "transforms.json").write_text(json.dumps(meta))
    try:
        verdict(lambda: load(capture), bytes_of(capture))
    finally:
        (capture / "transforms.json").write_text(content)


NAN = float("nan")
POSE, FIRST = "frames/1/transform_matrix", "images/frame_00001.png"
ROUND = {"camera_model": "FISHEYE624", "distortion_params": [0.0] * 12}


def masked(path):
    return lambda frames: [{**frame, "mask_path": path} for frame in frames]


REFUSED = {
    "NaN in a pose": ({f"{POSE}/0/3": NAN}, r"frame 1 .*transform_matrix is nan; it must be finite"),
    "a pose of zeros": ({POSE: [[0.0] * 4] * 4}, "frame 1 .*singular"),
    "a pose of 3 rows": ({POSE: [[1.0, 0, 0, 0]] * 3}, "4 rows of 4"),
    "no pose": ({POSE: GONE}, "4 rows of 4"),
    "zero focal length": ({"fl_x": 0.0}, "fl_x is 0.0; it must be positive"),
    "negative focal length": ({"fl_y": -3}, "fl_y is -3; it must be positive"),
    "no focal length": ({"fl_x": GONE}, "fl_x missing"),
    "zero width": ({"w": 0}, "w is 0; .*whole number of pixels"),
    "a huge width": ({"w": 10**9}, "w is 1000000000"),
    "half a pixel": ({"h": 16.5}, "h is 16.5"),
    "no frames": ({"frames": []}, "lists 0 images; training needs 2"),
    "one frame": ({"frames": lambda frames: frames[:1]}, "lists 1 image; training needs 2"),
    "an image twice": ({"frames": lambda frames: [*frames, frames[1]]}, r"two frames with the image .*2\.png; remove"),
    "frames that are numbers": ({"frames": [1, 2]}, "frame 0"),
    "an unknown camera": ({"camera_model": "BRAIN"}, "camera_model is 'BRAIN'; use one of SIMPLE_PINHOLE"),
    "a round lens without a radius": (ROUND, "fisheye_crop_radius is None; .*a positive number"),
    "a round lens of a whole number": ({**ROUND, "fisheye_crop_radius": 7}, "with a decimal point"),
    "a round lens and masks": ({**ROUND, "fisheye_crop_radius": 7.0, "frames": masked(FIRST)}, "remove mask_path"),
    "distortion NaN": ({"k1": NAN}, "k1 is nan"),
    "a term of FULL_OPENCV": ({"frames/1/k6": 0.2}, "frame 1 .*k6 is 0.2; it must be 0, or undistorted: make"),
    "distortion of 3 numbers": ({"distortion_params": [0, 0, 0]}, "needs distortion_params of 6 numbers"),
    "a split of other images": ({"frames/1/file_path": "images/none.png"}, "which no frame has as file_path"),
    "a missing split": ({"train_filenames": ["a.png"], "val_filenames": None}, "train_filenames|val_filenames"),
    "no list of test images": ({"val_filenames": GONE, "test_filenames": GONE}, "none for val"),
    "a mask for one": ({"frames/1/mask_path": FIRST}, "1 of .* frames have a mask_path"),
    "a scale of zero": ({"applied_scale": 0}, "applied_scale"),
    "a frame of NaN": ({"applied_transform": [[NAN] * 4] * 3}, "applied_transform"),
    "an unknown orientation": ({"orientation_override": ["up"]}, "orientation_override is"),
    "a cloud that is a number": ({"ply_file_path": 3}, "ply_file_path"),
    "a missing cloud": ({"ply_file_path": "none.ply"}, r"none\.ply does not exist"),
}


def test_valid_models_are_read(capture):
    assert verdict(lambda: load(capture, colmap=True), bytes_of(capture)) is None
    binary = load(capture, colmap=True)
    write_text_model(capture / "sparse/0", sorted(path.name for path in (capture / "images").iterdir()))
    load(capture, colmap=True)
    as_text(capture)
    text = load(capture, colmap=True)
    assert torch.equal(binary.train_dataset.cameras.camera_to_worlds, text.train_dataset.cameras.camera_to_worlds)
    clouds = [made.train_dataset.metadata["points3D_xyz"] for made in (binary, text)]
    torch.testing.assert_close(clouds[0], clouds[1], atol=1e-6, rtol=0)
    (capture / "sparse" / "0" / "points3D.txt").unlink()
    assert "points3D_xyz" not in load(capture, colmap=True).train_dataset.metadata
    (capture / "images" / "an image.png").write_bytes(next((capture / "images").iterdir()).read_bytes())
    as_text(capture)
    assert "an image.png" in {path.name for path in load(capture, colmap=True).train_dataset.image_filenames}


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@pytest.mark.parametrize("file", ["cameras", "images", "points3D"])
def test_a_model_cut_short_anywhere_is_refused(tmp_path, file, text):
    names = [f"{index}.png" for index in range(3)]
    write_text_model(tmp_path, names) if text else write_model(tmp_path, names, SIZE)
    path = tmp_path / f"{file}.{'txt' if text else 'bin'}"
    content = path.read_bytes()
    if text:  # as COLMAP does
        rows = 1 if file == "cameras" else len(names)
        content = f"# List of {file}\n# Number of {file[:6]}: {rows}, mean length: 2\n".encode() + content
    # The last entry of a text may lose letters or observations.
    end = content.rindex(b"2.png" if file == "images" else b"\n", 0, -1) if text else len(content)
    check_colmap(tmp_path, None)
    for length in range(end):
        if text and length < content.find(b"mean"):
            continue  # the count itself is cut
        path.write_bytes(content[:length])
        with pytest.raises(DataError):
            check_colmap(tmp_path, None)


def _patch(file, at, layout, *values):
    def change(model):
        data, content = bytearray((model / file).read_bytes()), struct.pack(layout, *values)
        data[at : at + len(content)] = content
        (model / file).write_bytes(data)

    return change


def _twice(model):
    (model / "cameras.bin").write_bytes(struct.pack("<Q", 2) + (model / "cameras.bin").read_bytes()[8:] * 2)


def _other_lens(model):
    write_text_model(model, sorted(path.name for path in (model.parents[1] / "images").iterdir()))
    _patch("cameras.bin", 8 + 24, "<d", 19.0)(model)


_NAME = 8 + 64 + len("frame_00001.png") + 1  # offset of the first image's number of observations
ROW = "1 1 0 0 0 0 0 3 1"
MODELS = {
    "2^63 cameras": (_patch("cameras.bin", 0, "<Q", 1 << 63), "is not a complete cameras.bin"),
    "2^30 observations": (_patch("images.bin", _NAME, "<Q", 1 << 30), "images.bin .*requires a buffer"),
    "fewer images": (_patch("images.bin", 0, "<Q", 3), r"images.bin of COLMAP \(its entries take \d+ bytes, it has"),
    "fewer points": (_patch("points3D.bin", 0, "<Q", 3), r"points3D.bin of COLMAP \(its entries take \d+ bytes, it"),
    "a track of 2^31": (_patch("points3D.bin", 8 + 43, "<Q", 1 << 31), "is not a complete points3D.bin"),
    "a focal length of 0": (_patch("cameras.bin", 8 + 24, "<d", 0.0), "camera 1: parameter fx is 0.0"),
    "a lens of RealityScan": (lambda model: _text(model, ROW, "1 RADIAL 9 9 9 4 4 -nan(ind) 0"), "1: its lens is NaN"),
    "a width of 0": (_patch("cameras.bin", 8 + 8, "<Q", 0), "width is 0"),
    "another camera model": (_patch("cameras.bin", 8 + 4, "<i", 7), "not support camera model FOV"),
    "an unknown camera model": (_patch("cameras.bin", 8 + 4, "<i", 99), "camera model 99 is not known here"),
    "a zero quaternion": (_patch("images.bin", 8 + 4, "<4d", 0, 0, 0, 0), "image 1: its quaternion"),
    "a NaN position": (_patch("images.bin", 8 + 36, "<d", float("nan")), "image 1: the pose is nan"),
    "a missing camera": (_patch("images.bin", 8 + 60, "<i", 9), "camera 9 is not in the model"),
    "a name for a shell": (_patch("images.bin", 8 + 64, "15s", b"$(reboot).png!!"), "has quotes, .*rename it"),
    "a name above": (_patch("images.bin", 8 + 64, "15s", b"..\\../a.png.png"), "leads out of the folder of images"),
    "an absolute name": (_patch("images.bin", 8 + 64, "15s", b"/etc/passwd.png"), "leads out of the folder of images"),
    "one image": (lambda model: _text(model, f"{ROW} a.png"), "has 1 image; training needs 2"),
    "an endless name": (_patch("images.bin", 8 + 64, "10000s", b"a" * 10**4), "is not a complete images.bin"),
    "no images": (lambda model: (model / "images.bin").write_bytes(bytes(8)), "has no images"),
    "no points": (lambda model: (model / "points3D.bin").write_bytes(bytes(8)), "has no points"),
    "no observations": (lambda model: _text(model, f"{ROW} a.png\n2{ROW[1:]} b.png"), "after image 1 stands no line"),
    "no files": (shutil.rmtree, "is not a folder"),
    "a pipe": (lambda model: ((model / "images.bin").unlink(), os.mkfifo(model / "images.bin")), "it is a pipe"),
    "no file of cameras": (lambda model: (model / "cameras.bin").unlink(), "holds neither cameras.bin nor cameras.txt"),
    "a camera twice": (_twice, "camera 1: it is listed twice"),
    "a number twice": (lambda model: _text(model, f"{ROW} a.png\n\n{ROW} b.png"), "image 1: .* is listed twice"),
    "a name twice": (lambda model: _text(model, f"{ROW} a.png\n\n2{ROW[1:]} a.png"), "image 2: .*'a.png' is .* twice"),
    "another text": (lambda model: write_text_model(model, ["a.png"]), "a text and a binary model that differ; remove"),
    "another lens": (_other_lens, "a text and a binary model that differ; remove"),
    "a folder in its place": (lambda model: ((file := model / "cameras.bin").unlink(), file.mkdir()), "cannot be read"),
    "invalid UTF-8": (lambda model: (model / "cameras.txt").write_bytes(b"1 PIN\xff\xfe"), "cameras.txt .*utf-8"),
    "a pose of 6 numbers": (lambda model: _text(model, "1 1 0 0 0 0 0 1 a.png"), "images.txt .*6 numbers as its pose"),
    "a missing image": (lambda model: next((model.parents[1] / "images").iterdir()).unlink(), "does not exist"),
}


def _text(model, image, *cameras):
    as_text(model.parents[1])
    (model / "images.txt").write_text(f"{image}\n\n")
    (model / "cameras.txt").write_text("\n".join(cameras or [(model / "cameras.txt").read_text()]))


def _written(text):
    return lambda data: (data / "transforms.json").write_text(text, errors="surrogateescape")


TEXTS = ("", "[1, 2]", "[" * 200_000, '{"frames": ' + "9" * 5000 + "}", '{"frames": [', "\udcff")
FOLDERS = {
    **{f"text {number}": (_written(text), "transforms.json") for number, text in enumerate(TEXTS)},
    "lists of 30 MB": (_written('{"frames": [' + "[]," * 9_900_000 + "[]]}"), "has more than .* two million lists"),
    "no folder": (shutil.rmtree, "does not exist; give the folder of the capture"),
    "no transforms": (lambda data: (data / "transforms.json").unlink(), "has no transforms.json; it is in COLMAP"),
}


@pytest.mark.parametrize("kind", [*REFUSED, *MODELS, *FOLDERS])
def test_captures_are_refused_by_name(capture, kind):
    change, cause = {**REFUSED, **MODELS, **FOLDERS}[kind]
    rewrite(capture, change) if kind in REFUSED else change(capture / ("sparse/0" if kind in MODELS else ""))
    refused(lambda data: load(data, colmap=kind in MODELS), capture, cause)


def bomb(width, height):
    content = b"\x89PNG\r\n\x1a\n"
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    for kind, data in ((b"IHDR", header), (b"IDAT", zlib.compress(b"\0" * 99)), (b"IEND", b"")):
        content += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return lambda path: path.write_bytes(content)


IMAGES = {
    "floats": (lambda path: Image.new("F", SIZE).save(path, format="TIFF"), "pixels of type F"),
    "PostScript": (lambda path: Image.new("RGB", SIZE).save(path, format="EPS"), "pixels of type EPS; save it"),
    "one pixel": (lambda path: Image.new("RGB", (1, 1)).save(path), "1 x 1 px but its camera says"),
    "empty": (lambda path: path.write_bytes(b""), "cannot identify image file"),
    "a folder": (lambda path: (path.unlink(), path.mkdir()), "cannot be read"),
    "missing": (lambda path: path.unlink(), "does not exist|none"),
    "a bomb": (bomb(30000, 30000), "claims|exceeds limit|30000"),
    "a smaller bomb": (bomb(9000, 9000), "claims 9000 x 9000 px"),
    "right header, no pixels": (bomb(WIDTH, HEIGHT), "image file is truncated"),
}


@pytest.mark.parametrize("which", ["train", "test"])
@pytest.mark.parametrize("kind", IMAGES)
def test_images_are_refused_by_name(capture, kind, which):
    make, cause = IMAGES[kind]
    name = meta_of(capture)[f"{which}_filenames"][-1]  # nerfstudio opens the first
    make(capture / name)
    if (kind, which) == ("right header, no pixels", "test"):
        return  # detected when the test views are decoded
    refused(load, capture, f"{Path(name).name}.*({cause})")


def _each_image(change):
    def make(data):
        for path in (data / "images").iterdir():
            with Image.open(path) as image:
                changed = change(image)
            changed.save(path)

    return make


HALF = np.repeat(np.array([[255, 0]], np.uint8), WIDTH // 2, axis=1).repeat(HEIGHT, axis=0)


def _renamed(data):
    for path in list((data / "images").iterdir()):
        path.rename(path.with_name("ünï cöde 像 " + path.name))
    text = (data / "transforms.json").read_text().replace("images/", "images/ünï cöde 像 ")
    (data / "transforms.json").write_text(text, encoding="utf-8")


def _one_pixel(data):
    _each_image(lambda image: image.resize((1, 1)))(data)
    rewrite(data, {"w": 1, "h": 1, "cx": 0.5, "cy": 0.5})


def _masked(data):
    photo(data / "masks" / "half.png", image=Image.fromarray(HALF))
    rewrite(data, {"frames": masked("masks/half.png")})


def _of_windows(data):
    path = data / "transforms.json"
    path.write_text(path.read_text().replace("images/", r"images\\"))


FINE = {
    "unchanged": lambda data: None,
    **{mode: _each_image(lambda image, mode=mode: image.convert(mode)) for mode in ("1", "L", "LA", "P", "RGBA")},
    "one pixel": _one_pixel,
    "masks": _masked,
    "unicode and spaces in names": _renamed,
    "paths of Windows": _of_windows,
    "a mark of UTF-8": lambda data: rewrite(data, {"skew": 0.0}, b"\xef\xbb\xbf"),
    "no points": lambda data: rewrite(data, {"ply_file_path": GONE}),
}


def train_a_step(data):
    datamanager = load(data)
    metadata = datamanager.train_dataset.metadata
    points = [metadata[f"points3D_{name}"] for name in ("xyz", "rgb") if "points3D_xyz" in metadata]
    model = _build(seed_points=points or None, metadata=metadata, num_random=50).train()
    model.step = 4
    camera, batch = datamanager.next_train(0)
    outputs = model(camera)
    loss = torch.stack(list(model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch)).values())).sum()
    loss.backward()
    assert torch.isfinite(loss)
    model.eval()
    for camera, batch in datamanager.fixed_indices_eval_dataloader:
        metrics, _ = model.get_image_metrics_and_images(model.get_outputs_for_camera(camera), batch)
        assert np.isfinite(metrics["psnr"])


@pytest.fixture(scope="module")
def compiled(scene):
    """Compile the CPU rasteriser before its first use under limits of time and memory."""
    train_a_step(scene)


@pytest.mark.parametrize(("kind", "folder"), [*zip(FINE, itertools.cycle(("a folder, with spaces", "ünï cöde 像")))])
def test_unusual_captures_train(compiled, capture, kind, folder):
    data = capture.rename(capture.with_name(folder))
    FINE[kind](data)
    assert verdict(lambda: train_a_step(data), bytes_of(data)) is None


@pytest.mark.parametrize(("made", "factors"), [((), "1"), (("images_2", "images_8"), "1, 2, 8")])
def test_a_missing_size_is_named_with_what_makes_it(capture, made, factors):
    for name in made:
        (capture / name).mkdir()
    with pytest.raises(DataError) as error:
        manager(capture, downscale_factor=3)
    make = f"`mkdir images_3 && magick mogrify -path images_3 -resize {WIDTH // 3}x{HEIGHT // 3}! images/*`"
    assert f"give another --downscale-factor ({factors}), or make it with {make}" in str(error.value)


def test_training_sees_srgb(capture):
    name = meta_of(capture)["train_filenames"][0]
    with Image.open(capture / name) as image:
        image.load()
    image.save(capture / name, icc_profile=profile("P3"))
    trained = load(capture).cached_train[0]["image"].numpy().astype(int)
    assert np.abs(trained - judged(image, "P3")).max() <= 1 < 5 < np.abs(trained - np.asarray(image)).max()
