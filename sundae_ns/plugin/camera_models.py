"""Checks of a parsed capture: cameras, projections, and where the cloud lies."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from sundae_ns.core.camera import Camera, world_to_camera, world_to_camera_floats
from sundae_ns.core.errors import DataError
from sundae_ns.data.capture import read_json
from sundae_ns.plugin.dataparsers import STRAY, TYPES, stray_cameras
from sundae_ns.scene.load_save import FRAME_FILE
from sundae_ns.train.progress import warn


def check_cameras(cameras: Cameras, names: Sequence[Path], points: Tensor | None = None) -> None:
    """Refuse or warn of poses and lenses of the cameras ``[N]`` of training images ``names``, in any units.

    ``points`` of the scene ``[M, 3]`` have the same coordinates.

    Raises:
        DataError: a projection is none of a lens, an axis is mirrored, or a focal length belongs to no lens.
    """
    kinds = cameras.camera_type.flatten()
    ratios = (cameras.fx / cameras.width.clamp_min(1)).flatten()
    mirrored = torch.linalg.det(cameras.camera_to_worlds[:, :, :3]) < 0
    for flags, cause in (
        (
            ~torch.isin(kinds, torch.tensor(list(TYPES.values()), dtype=kinds.dtype)),
            "the camera of {name} is of type {kind}, which no perspective image can be made of; cut its images into "
            "perspective ones, such as cube faces",
        ),
        (
            mirrored,
            "the pose of {name} mirrors an axis ({mirrored} of {count} poses do); negate one column of its rotation",
        ),
        (
            (ratios < 0.01) | (ratios > 1000),  # views of 178 and of 0.06 degrees
            "the focal length of {name} is {focal:.3g} px and the image is {width} px wide, which no lens has; give "
            "the focal length in pixels",
        ),
    ):
        if flags.any():
            i = _first(flags)
            kind, focal, width = CameraType(int(kinds[i])).name, float(cameras.fx[i]), int(cameras.width[i])
            numbers = {"mirrored": int(mirrored.sum()), "count": len(names), "focal": focal, "width": width}
            raise DataError(cause.format(name=names[i].name, kind=kind, **numbers))
    centres = cameras.camera_to_worlds[:, :, 3]
    middle = centres.median(dim=0).values
    distances = (centres - middle).norm(dim=1)
    if len(names) > 1 and distances.max() == 0:
        warn("all cameras stand at one place, so nothing says how far things are; check the poses")
        return
    usual = distances.median()
    cloud = None if points is None or not len(points) else points
    far = torch.from_numpy(
        stray_cameras(centres.double().numpy(), lambda: None if cloud is None else cloud.double().cpu().numpy())
    )
    if not far.any() and usual > 0:
        reach = 0.0 if cloud is None else float((cloud - middle).norm(dim=1).median())
        far = (distances > 20 * usual) & (distances > STRAY * reach)
    if far.any():
        times = f"{float(distances[_first(far)] / usual):,.0f} times as far away as most"
        warn(
            f"the camera of {names[_first(far)].name} is {times if usual > 0 else 'far from all others'} "
            f"({int(far.sum())} of {len(names)} are); check its pose, or remove the view"
        )


def warn_of_stray_tests(train: Cameras, test: Cameras, names: Sequence[Path]) -> None:
    """Warn of test cameras ``[M]``, of images ``names``, that stand far from all others."""
    centres = torch.cat([train.camera_to_worlds[:, :, 3], test.camera_to_worlds[:, :, 3]]).double().cpu()
    far = torch.from_numpy(stray_cameras(centres.numpy()))[len(train) :]
    if far.any():
        warn(
            f"the camera of {names[_first(far)].name}, a test view, stands far from all others ({int(far.sum())} of "
            f"{len(names)} do); check its pose, or remove the view"
        )


def _first(flags: Tensor) -> int:
    """Index of the first True."""
    return int(flags.nonzero()[0])


def check_projection(camera: Cameras) -> None:
    """Raise ``DataError`` for a camera that asks for another projection, as a camera path may; ours are perspective."""
    kind = CameraType(int(camera.camera_type.flatten()[0]))
    if kind != CameraType.PERSPECTIVE:
        raise DataError(
            f"the camera is of type {kind.name.lower()}, and only perspective images can be drawn; set camera_type to "
            "perspective in the camera path, for a panorama render the six faces of a cube"
        )


@torch.no_grad()
def warn_of_cloud(points: Tensor, cameras: Cameras) -> None:
    """Warn of a cloud ``[N, 3]`` that most cameras do not see: it and the cameras are in different coordinates.

    Looks for 2,000 of the points, without distortion, with a margin of a tenth of the image's size on each side.
    """
    points = points[torch.isfinite(points).all(dim=1)].cpu()
    points = points[torch.linspace(0, max(len(points) - 1, 0), min(2000, len(points))).long()]
    empty = 0
    parts = (cameras.fx, cameras.fy, cameras.cx, cameras.cy, cameras.width, cameras.height)
    lenses = torch.cat([part.float() for part in parts], dim=-1).cpu()
    for pose, (fx, fy, cx, cy, width, height) in zip(cameras.camera_to_worlds.cpu(), lenses.tolist(), strict=True):
        x, y, z = ((points - pose[:, 3]) @ pose[:, :3]).unbind(dim=1)
        across, down = (x * fx / -z + cx) / width, (-y * fy / -z + cy) / height
        inside = (across > -0.1) & (across < 1.1) & (down > -0.1) & (down < 1.1)
        empty += not ((z < 0) & inside).any()
    if empty > 0.5 * len(cameras):
        warn(
            f"{empty} of {len(cameras)} views show no point of the sparse cloud, so cloud and cameras are probably in "
            "different coordinates; export both together, or train without the cloud (remove ply_file_path)"
        )


def warn_of_other_frame(run: Path, transform: Tensor, scale: float) -> None:
    """Warn if a run, by its folder, was trained in other coordinates than those of a transform ``[3, 4]`` and scale."""
    try:
        stated = read_json(run / FRAME_FILE)
        before, size = torch.tensor(stated["transform"], dtype=torch.float64), float(stated["scale"])
        same = torch.allclose(before * size, transform.double() * scale, rtol=1e-3, atol=1e-3)
    except (DataError, KeyError, TypeError, ValueError, RuntimeError):
        return
    if not same:
        warn(
            f"{run} was trained in other coordinates: its capture has changed, or another version scaled it; if "
            "cameras stand far apart, resume it with --pipeline.datamanager.robust-frame False"
        )


def camera_of(camera: Cameras, device: torch.device | str, *, pose: Tensor | None = None, downscale: int = 1) -> Camera:
    """The rasteriser's form of a camera of shape ``(1,)``; ``camera`` does not change.

    Args:
        camera: nerfstudio camera, camera-to-world with OpenGL axes.
        device: device of the view.
        pose: camera-to-world in place of the camera's own, ``[..., 3, 4]``; differentiable.
        downscale: divisor of the resolution.
    """
    # nerfstudio's methods of cameras build tensors and cameras at each call; here one copy from the device does.
    parts = (camera.camera_to_worlds, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    *flat, fx, fy, cx, cy, width, height = torch.cat([part.detach().flatten() for part in parts]).tolist()
    dtype = camera.camera_to_worlds.dtype
    K = [fx / downscale, 0.0, cx / downscale, 0.0, fy / downscale, cy / downscale, 0.0, 0.0, 1.0]
    size = (int(width) // downscale, int(height) // downscale)
    if pose is None:
        # In one tensor: one copy to a GPU.
        both = torch.tensor([*world_to_camera_floats(flat), *K], dtype=dtype).to(device)
        viewmat, intrinsics = both[:16].view(4, 4), both[16:].view(3, 3)
    else:
        viewmat = world_to_camera(pose.reshape(-1, 3, 4)[0]).to(device)
        intrinsics = torch.tensor(K, dtype=dtype).to(device).view(3, 3)
    return Camera(viewmat, intrinsics, *size, (fx + fy) / 2 / downscale)
