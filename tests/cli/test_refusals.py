"""What each command refuses: one line with the cause and the remedy, before anything is written or started."""

import dataclasses
import shlex
import sys

import pytest
import torch
from colmap_models import write_model
from command_line import refusal
from fake_colmap import FakeColmap
from run_commands import PHOTOS, photo, write_video

import sundae_ns as sn

LONG = "x" * 300
REFUSALS = {
    f"prune in.ply -o {LONG}.ply": "too long",
    f"prune {LONG} -o x.ply": "too long",
    "fly": "there is no command fly; sundae --help lists them",
    "compair": "use compare",
    "prune in.ply": "Missing from sundae prune: -o PATH, --out PATH; sundae prune --help shows the options",
    "prune in.ply -o a.ply --kep 3": "Unrecognized options: --kep, 3; Perhaps you meant: --keep SHARE; sundae",
    "prune in.ply -o a.ply --count x": "Error parsing --count: no number: 'x'; sundae prune --help shows",
    "render in.ply -o a.png --up 0 0": "Missing value for argument '--up'. Expected 3 values; sundae render --help",
    "demo text.mp4": "text.mp4 is a file; choose another folder",
    "demo out --steps 0": "steps is 0; give at least 1",
    "prune nothing.ply -o a.ply": "nothing.ply cannot be read",
    "prune in.ply -o a.ply --keep 250%": "keep is 2.5; give a share in (0, 1]",
    "prune in.ply -o a.splat": "a.splat has no supported suffix",
    "prune in.ply -o a.ply --keep 0.1 --count 5": "--keep and --count exclude each other",
    "prune in.ply -o a.ply --keep 0.1 --target-drop 1": "--keep and --target-drop exclude",
    "prune in.ply -o a.ply --target-drop 0": "target-drop is 0.0; give at least 0.001",
    "prune in.ply -o a.ply --target-drop 1 --num-cameras 1": "a target needs two",
    "prune in.ply -o a.ply --max-mb inf": "max-mb is inf; give less, at least 0.001",
    "prune in.ply -o a.ply --num-cameras 0": "num-cameras is 0; give at least 1",
    "prune in.ply -o a.ply --data photos": "--data is the capture of a run, and in.ply is none; leave it out",
    "prune in.ply -o a.ply --num-cameras 10001": "n is 10001; give at most 10,000",
    "prune in.ply -o a.ply --seed 99999999999999999999": "seed is 99999999999999999999; give at most 9,223,372,",
    "prune empty.ply -o a.ply": "empty.ply has 0 Gaussians, and none is finite; export it again",
    "prune in.ply -o /proc/a.ply": "cannot write to /proc (",
    "pack page.html -o a.sundae": "page.html is not a page with its scene (",
    "prune trained -o a.ply": "trained is a folder of 3DGS; give trained/point_cloud/iteration_30000/point",
    "prune in.ply -o b.ply --distill": "b.ply cannot hold a head; name it .sundae, or leave",
    "prune in.ply -o b.sundae --distill --steps 0": "steps is 0; give a whole number, at least 1",
    "prune in.ply -o b.html --max-mb 0.01": "a file without Gaussians has",
    "prune in.ply -o b.ply --start-view 0": ".ply files hold no start view; leave it out, or name a .sundae or .html",
    "export in.ply -o a.splat": "name it .ply, .spz, .sog, .glb, .html",
    "export in.ply -o in.bin/new/a.sog": "in.bin is no folder",
    "export in.ply -o a.ply": "in.ply is a .ply already; name another suffix, or what to change",
    "export in.ply -o a.sog --lod": "name one without a suffix, and leave out --max-mb",
    "export in.ply in.ply -o a.ply": "or a start view; name it .html; sn.merge joins two",
    "export in.ply -o a.sog --upright": "not in nerfstudio's coordinates",
    "export in.sundae -o a.html --upright": "leave out --upright",
    "export in.bin -o a.ply": "in.bin is not a complete .spz (",
    "pack in.sundae -o a.sundae --finetune 9": "in.sundae is a packed scene without photos; leave out",
    "pack in.ply -o a.sundae --seed -5": "seed is -5; give at least 0",
    "pack in.ply -o a.sundae --start-view 0": "there is no camera 0 in the scene; give a camera file",
    "pack in.ply -o a.sundae --target-drop 1": "leave out --target-drop, or give a run",
    "prune gone -o a.ply --remove-floaters 15e-1": "remove-floaters is 1.5; give 0 (careful) to 1",
    "pack in.ply -o a.sundae --finetune 5 --crop 0 0 0 1 1 1": "leave out --crop",
    "pack in.ply -o a.spz": "a.spz is a name of another format; name it .sundae, or write it with sundae export",
    "pack gone -o a.sundae": "gone does not exist",
    "pack gone -o a.sundae --finetune -1": "finetune is -1",
    "pack gone -o a.sundae --target-drop nan": "target-drop is nan",
    "pack gone -o a.sundae --target-drop 1 --max-mb 9": "exclude each other",
    "compare a.lcc in.ply -o out": "a.lcc is a scene of XGRIDS; convert it to .ply with",
    "info a.usdz": "a.usdz is a scene of OpenUSD; export its Gaussians as .ply or .glb",
    "info a.ssproj": "a.ssproj is an archive; unpack it, and give its scene",
    "compare in.ply -o out": "needs two scenes; give another, --formats, or --data with a capture",
    "compare in.ply --data none": "none does not exist; give the folder of the capture with --data",
    "compare in.ply gone.ply": "gone.ply does not exist",
    "compare in.ply -o . --overwrite": "holds what the command reads",
    "view damaged.json": "damaged.json is no run; give a run, its config.yml, or a .sundae",
    "export trained/point_cloud -o a.html": "trained/point_cloud is no run; give a run",
    "render a.pth -o a.png": "a.pth is a checkpoint of another trainer; give its .ply",
    "render in.sundae -o a.png": "there are 2 cameras; give --view 0 to 1, or write an .mp4",
    "render in.sundae -o a.gif --view 0": "a.gif has no supported suffix; name it .png",
    "render in.sundae -o a.png --view 0 --width 1": "width is 1; give at least 2",
    "render in.sundae -o a.png --view 0 --fps 9": "--fps is of a video",
    "render in.sundae -o a.mp4 --view 0": "--view of an image; leave it out",
    "render in.sundae -o a.mp4 --fps nan": "--fps is of a video",
    "render in.sundae -o a.png --view 0 --preview ./a.png --remove-floaters": "a.png is the image and its --preview",
    "render in.sundae -o a.png --cameras in.ply": "); give a transforms.json, the folder of a COLMAP model, or",
    "train scene --seed -1": "seed is -1; give at least 0",
    "train scene --count 9 --crop 0 0 0 1 1 1": "reaches --count before --crop cuts; give both to sundae pack",
    "train scene --method splatfacto": "splatfacto is no method of sundae; use one of sundae, ",
    "train empty": "empty has no transforms.json; ",
    "train text.mp4": "text.mp4 is a file, not a capture; sundae poses makes a capture of a video",
    "train a.xml": "a.xml is a file, not a capture; export its cameras as COLMAP, and give their folder, with the",
    "run a.XML -o out": "a.XML is a file, not a capture; export its cameras as COLMAP",
    "train scene photos": "photos is no option; options of ns-train follow a --",
    "train scene --resume --steps 5": "leave out --steps or --resume",
    "train scene --resume": "outputs has no unfinished run of sundae on scene; leave out --resume",
    "poses empty -o out": "empty holds no photos",
    "poses gone -o out": "gone cannot be read (No such file or directory); check the path",
    "poses trained -o out": "or a video by its own path",
    "poses text.mp4 -o out": "text.mp4 is not a video that",
    "poses photos/0.JPG -o out": "give the folder of photos",
    "poses photos -o photos/capture": "photos/capture lies in photos",
    "poses photos -o out --frames 2": "frames is 2; give at least 3",
    "poses walk.mp4 -o out --masks empty": "a video has no masks",
    "run gone -o out": "gone does not exist; check the path",
    "run model -o out": "cameras.bin is not a complete cameras.bin of COLMAP",
    "run model/sparse/0 -o out": "is a COLMAP model without its images",
    "run undistorted -o out": "undistorted has no image 0.png, which its model dense/sparse states",
    "run blender -o out": "blender/transforms_train.json is not JSON",
    "run photos -o photos/out": "lies in photos",
    "run photos -o .": "holds what the command reads",
    "run photos -o used": "used holds files; choose another folder",
    "compare in.ply in.sundae --formats": "one scene with itself; leave out in.sundae",
    "view in.ply --count 0": "count is 0; give at least 1",
    "run photos -o out --quality best --method sundae-fast": "--quality best needs a method that",
    "run photos -o out --quality draft --steps 9": "a draft has 3,000 steps",
    "run photos -o out --masks gone": "photos/0.JPG has no mask 0.png in gone; add it",
    "run posed -o out --masks gone": "gone/0.png, a mask, is missing; check --masks, or add it",
    "run scene -o out --masks gone": "scene is not in COLMAP's layout; give frames their mask_path",
    "train posed --masks photos": "photos/0.png, a mask, is missing",
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder with scenes, photos and captures, right and wrong."""
    folder = tmp_path_factory.mktemp("inputs")
    points = torch.rand(200, 3)
    scene = sn.Scene.from_points(points, points)
    cameras = tuple(sn.Camera.look_at((x, -2, 0.5), (0.5, 0.5, 0.5), width=41, height=31) for x in (0.0, 1.0))
    sn.save(scene, folder / "in.ply")
    sn.save(dataclasses.replace(scene, cameras=cameras), folder / "in.sundae")
    header, _ = (folder / "in.ply").read_bytes().split(b"end_header\n")
    (folder / "empty.ply").write_bytes(header.replace(b"vertex 200", b"vertex 0") + b"end_header\n")
    contents = {"in.bin": b"\x1f\x8b\xff", "damaged.json": b"{"}
    contents |= dict.fromkeys("a.lcc a.pth page.html a.ssproj a.usdz a.xml a.XML".split(), bytes(33))
    contents |= {"text.mp4": b"not a video", "trained/point_cloud/iteration_30000/point_cloud.ply": b""}
    contents["trained/point_cloud/iteration_7000/point_cloud.ply"] = b""  # written later
    empty = "scene/transforms.json", "model/sparse/0/cameras.bin", "blender/transforms_train.json", "used/thesis.txt"
    for name, content in {**contents, **dict.fromkeys(empty, b"")}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    (folder / "empty").mkdir()
    for index in range(PHOTOS):
        photo(folder / f"photos/{index}.JPG")
    write_video(folder / "walk.mp4", 9)
    write_model(folder / "undistorted/dense/sparse", ["0.png"], (20, 16))
    write_model(folder / "posed/sparse", ["0.JPG"], (20, 16))
    photo(folder / "posed/images/0.JPG")
    return folder


@pytest.mark.parametrize("words", REFUSALS)
def test_refusals_are_one_line(words, inputs, monkeypatch, capsys):
    monkeypatch.chdir(inputs)
    monkeypatch.setitem(sys.modules, "pycolmap", FakeColmap())
    before = sorted(inputs.rglob("*"))
    assert REFUSALS[words] in refusal(capsys, *shlex.split(words))
    assert sorted(inputs.rglob("*")) == before
