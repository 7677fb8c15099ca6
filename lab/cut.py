"""Cut captures to few training views, the test views first: every 8th image of the capture stays for the test.

    python lab/cut.py CAPTURE OUT -n 16

Points are those that two of the training views see, or where there are no tracks those that pycolmap triangulates.
"""

import argparse
import shutil
from pathlib import Path

import numpy as np
from few_views import seen_twice, spread, triangulated
from nerfstudio.data.utils import colmap_parsing_utils as colmap


parser = argparse.ArgumentParser()
parser.add_argument("capture", type=Path)
parser.add_argument("out", type=Path)
parser.add_argument("-n", type=int, default=16)
args = parser.parse_args()
cameras, images, points = colmap.read_model(str(args.capture / "sparse/0"), ext=".bin")
order = sorted(images.values(), key=lambda image: image.name)
test = order[::8]
rest = [image for index, image in enumerate(order) if index % 8]
train = [rest[i] for i in spread(len(rest), args.n)]
for folder in ("images", "sparse/0"):
    (args.out / folder).mkdir(parents=True, exist_ok=True)
chosen, none = {}, np.zeros(0, int)
for kind, group in (("train", train), ("eval", test)):
    for image in group:
        name = f"{kind}_{image.name.replace('/', '_')}"
        chosen[image.id] = image._replace(name=name, xys=np.zeros((0, 2)), point3D_ids=none)
        shutil.copyfile(args.capture / "images" / image.name, args.out / "images" / name)
kept = seen_twice(points, {image.id for image in train}) if any(len(p.image_ids) for p in points.values()) else {}
if not kept:
    kept = triangulated(cameras, [chosen[image.id] for image in train], args.out / "images")
bare = {key: point._replace(image_ids=none, point2D_idxs=none) for key, point in kept.items()}
colmap.write_model(cameras, chosen, bare, str(args.out / "sparse/0"), ext=".bin")
print(f"{args.out.name}: {len(train)} training, {len(test)} test, {len(kept):,} points")
