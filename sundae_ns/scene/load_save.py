"""Scenes as files: packed scenes, Gaussians of any program, and runs of ns-train. Needs no nerfstudio."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sundae_ns.core.errors import CheckpointError, ConfigError, DataError
from sundae_ns.core.files import at_home, write_bytes
from sundae_ns.core.gaussians import FEATURES
from sundae_ns.data.capture import read_json
from sundae_ns.head.head import SIZES, CompensationHead, HeadConfig
from sundae_ns.io import checkpoint, formats
from sundae_ns.io.config_file import find_config, model_options, value_of
from sundae_ns.io.pack.config import PackConfig
from sundae_ns.io.ply import Marks
from sundae_ns.io.run_folder import FRAME_FILE
from sundae_ns.scene.cameras import is_frame
from sundae_ns.scene.page import opened_page, packed_of, shown_as, write_page
from sundae_ns.scene.scene import Scene

SUFFIXES = (*formats.FORMATS, ".sundae", ".html")  # of the files that save() writes


def load(path: Path | str, *, device: torch.device | str = "cpu") -> Scene:
    """Open a finished scene. Nothing in its files is executed, and nerfstudio is not needed.

    Opacities of 0 or 1 and widths of 0 become finite; other NaN or infinite Gaussians are dropped, with a warning.

    Args:
        path: a ``.ply``, also a compressed one, a ``.spz``, ``.sog`` (a ``lod-meta.json`` too), ``.glb``, ``.splat`` or
            ``.ksplat`` of any program, a checkpoint of gsplat (``.pt``), a packed ``.sundae`` or its page (``.html``),
            or a run of ``ns-train`` with sundae or splatfacto: its folder, ``config.yml`` or one of its checkpoints.
        device: of the scene.

    Raises:
        DataError: a file of Gaussians is missing, damaged, or has no finite Gaussian.
        PackError: a packed scene is damaged, or states impossible values.
        CheckpointError: there is no such run, it is of another method, or has no whole checkpoint.

    >>> import pathlib, tempfile, torch, sundae_ns as sn
    >>> path = pathlib.Path(tempfile.mkdtemp(), "cloud.glb")
    >>> sn.save(sn.Scene.from_points(torch.rand(50, 3), torch.rand(50, 3)), path)
    >>> sn.load(path)
    Scene(50 Gaussians, SH degree 0, no head, cpu)
    """
    return load_with_mask(at_home(path), device)[0]


def load_with_mask(path: Path, device: torch.device | str = "cpu") -> tuple[Scene, Tensor | None]:
    """As :func:`load`, with True for the Gaussians of a file that the scene has, bool ``[N]``; None for others."""
    if (kind := formats.kind_of(path)) == "packed" or (kind is None and path.suffix.lower() == ".sundae"):
        from sundae_ns.io.pack.packed_scene import read_scene
        from sundae_ns.scene.packing import scene_of  # its decoder needs a compiler, which other files do not

        return scene_of(read_scene(path)).to(device), None
    if path.suffix.lower() == ".html":
        with opened_page(path) as packed:
            return load_with_mask(packed, device)
    if formats.kind_of_gaussians(path) is None:
        if (config := find_config(path)) is None:
            raise no_scene(path)
        source = (path, checkpoint.read(path)) if path.suffix == ".ckpt" else checkpoint.read_newest(config.parent)
        return scene_of_checkpoint(*source, config).to(device), None
    sanitised, marks = formats.read_gaussian_file(path)
    up = formats.up_of(path, sanitised.gaussians["means"], marks)
    facts: dict[str, Any] = {"antialiased": marks.antialiased, "in_model_frame": marks.in_model_frame, "up": up}
    if rows := [[*(float(i == j) for j in range(3)), -value] for i, value in enumerate(marks.offset or ())]:
        facts["meta"] = {"frame": {"transform": rows, "scale": 1.0}}
    return Scene(sanitised.gaussians, **facts).to(device), sanitised.mask


def no_scene(path: Path) -> CheckpointError:
    """The error for a path without a scene that any reader takes, and for one that is missing."""
    reason = "is no run" if path.exists() else "does not exist"
    wanted = "give a run, its config.yml, or a .sundae, .ply, .spz, .sog, .glb, .splat, .ksplat or .pt file"
    return CheckpointError(f"{path} {formats.unread(path) or f'{reason}; {wanted}'}")


def save(scene: Scene, path: Path | str, *, upright: bool = False, config: PackConfig | None = None) -> None:
    """Write a scene in the format of the file's suffix, atomically; an existing file is replaced.

    ``.sundae`` holds everything that a render needs, quantised. ``.html`` is a web page that renders it. ``.ply``
    and ``.glb`` (exact), ``.spz`` and ``.sog`` (quantised) hold base colours only, for other viewers.

    Args:
        scene: any device.
        path: file to write; a missing folder of it is made.
        upright: turn from nerfstudio's z-up axes to the -y-up axes of viewers; not a ``.glb``, which is always upright.
        config: precision of a packed scene or of that in a page; by default ``PackConfig()``.

    Raises:
        ConfigError: the suffix is not supported, or the format is not turned.
        DataError, PackError, StorageError: the format cannot store the scene; the disk is full or not writable.

    >>> import pathlib, tempfile, torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(50, 3), torch.rand(50, 3))
    >>> path = pathlib.Path(tempfile.mkdtemp(), "cloud.sundae")
    >>> sn.save(scene, path)
    >>> sn.load(path).num_gaussians
    50
    """
    path = at_home(path)
    if (suffix := path.suffix.lower()) not in SUFFIXES:
        raise ConfigError(f"{path} has no supported suffix; name it {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}")
    if upright and suffix not in formats.FORMATS:
        raise ConfigError(f"{suffix} files keep their coordinates; leave out upright")
    if suffix in formats.FORMATS:
        formats.write_for_viewers(path, scene.gaussians, marks_of(scene), upright=upright)
    elif suffix == ".html":
        write_page(path, shown_as(path.resolve().stem, scene, config))
    else:
        write_bytes(path, packed_of(scene, config))


def marks_of(scene: Scene) -> Marks:
    """The marks of a scene that a file of Gaussians may state."""
    return Marks(scene.antialiased, scene.in_model_frame, scene.up, scene.offset)


def scene_of_checkpoint(source: Path, loaded: Mapping[str, Any], config: Path) -> Scene:
    """The scene of a checkpoint with the contents ``loaded``, on the CPU; ``CheckpointError`` if they do not fit."""
    options = model_options(config)
    gaussians, state = checkpoint.gaussians_of(loaded, source), checkpoint.model_state(loaded)
    extra = entries if isinstance(entries := state.get(checkpoint.EXTRA_STATE), Mapping) else {}
    focal = extra.get("trained_focal")
    head = _head_of(state, options, source) if extra.get("head_enabled") else None
    if head is not None:
        gaussians[FEATURES] = state[f"gauss_params.{FEATURES}"].float()
    if options.get("warm_start") is None and isinstance(interval := options.get("sh_degree_interval"), int):
        degree = int(loaded["step"]) // max(interval, 1)  # training did not reach higher ones
        gaussians["features_rest"] = gaussians["features_rest"][:, : (degree + 1) ** 2 - 1]
    gaussians = formats.usable(gaussians, source).gaussians
    orientation = value_of(config, "pipeline", "datamanager", "dataparser", "orientation_method")
    frame: dict[str, Any] = {}
    with suppress(DataError):
        frame = read_json(config.parent / FRAME_FILE)
    return Scene(
        gaussians,
        head,
        background_color=options.get("background_color", "random"),
        antialiased=options.get("rasterize_mode") == "antialiased",
        trained_focal=(float(focal[0]), float(focal[1])) if head is not None and focal else None,
        up=(0.0, 0.0, 1.0) if orientation in ("up", "vertical") else None,
        in_model_frame=True,
        meta={"source": {"step": int(loaded["step"])}, **({"frame": frame} if is_frame(frame) else {})},
    )


def _head_of(state: Mapping[str, Any], options: Mapping[str, Any], source: Path) -> CompensationHead | None:
    """The head of a checkpoint. Its size is that of its weights: training may choose another than configured."""
    prefix = "networks.head."
    weights = {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
    if not weights or not isinstance(features := state.get(f"gauss_params.{FEATURES}"), Tensor):
        return None
    known = options["head"] if isinstance(options.get("head"), dict) else {}
    fields = {name: known[name] for name in ("pixel_unshuffle", "precision") if name in known}
    fields["mode"] = "features" if known.get("mode") == "features" else "residual"
    for size in sorted(SIZES, key=lambda size: size != known.get("size")):
        config = HeadConfig(size=size, num_features=features.shape[1], **fields)  # type: ignore[arg-type]
        if (head := CompensationHead.of_weights(config, weights)) is not None:
            return head
    raise CheckpointError(f"{source} has a head that does not fit its own config.yml; give another run")
