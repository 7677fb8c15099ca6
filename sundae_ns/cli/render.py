"""``sundae render``: a scene as an image or a video."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from sundae_ns.cli.inputs import opened
from sundae_ns.cli.options import Advanced, Float, Int, Out, Plain, Scene, SceneDetails, Wishes, progress_bar
from sundae_ns.cli.refusals import check_file, check_least, check_suffix
from sundae_ns.core.errors import ConfigError
from sundae_ns.core.files import replacing, write_image, write_video
from sundae_ns.rasterize.interface import fastest_device
from sundae_ns.scene.cameras import MOST_CAMERAS, film_views, opening
from sundae_ns.scene.scene import image_of
from sundae_ns.scene.scene import render as render_view


def render(
    scene: Scene,
    out: Out,
    view: Int = None,
    width: Int = None,
    seconds: Float = None,
    fps: Float = None,
    wishes: Plain[Wishes] = Wishes(),  # noqa: B008
    advanced: Advanced[SceneDetails] = SceneDetails(),  # noqa: B008
) -> int:
    """Render a scene to an image, or along a path to a video.

    A video is a film on a smooth path through the cameras, or where detail is seen; of a camera path, all its frames.

    Args:
        out: image (.png, .jpg or .webp) or video (.mp4) to write.
        view: index of the camera of an image; by default the start view of the scene, if it has one.
        width: width of the images in pixels; by default that of the camera, in a film at most 1,280 a side.
        seconds: length of a film; by default 12.
        fps: frames a second of a video; by default those of the camera path, else 24.
    """
    video = check_suffix(out, (".png", ".jpg", ".jpeg", ".webp", ".mp4")) == ".mp4"
    check_least(width=(width, 2))
    if fps is not None and not (video and 0 < fps <= 240):
        raise ConfigError("--fps is of a video, from above 0 to 240; leave it out, or name a video .mp4")
    check_file(out, reads=[scene, advanced.cameras], overwrite=advanced.overwrite)
    if advanced.preview is not None and advanced.preview.resolve() == out.resolve():
        raise ConfigError(f"{out} is the image and its --preview; name another file for one")
    edit = opened(scene, wishes, advanced, most=MOST_CAMERAS)
    views = list(edit.scene.cameras)
    if (seconds is not None and (edit.speed is not None or not video)) or (video and view is not None):
        raise ConfigError("--seconds is the length of a film without a camera path, --view of an image; leave it out")
    if not video and view is None and (advanced.start_view is not None or advanced.cameras is None):
        views = [edit.scene.start] if edit.scene.start else views
    if not video and ((view is None and len(views) > 1) or (view or 0) not in range(max(len(views), 1))):
        several = f"there are {len(views)} cameras; give --view 0 to {len(views) - 1}, or write an .mp4"
        raise ConfigError(several if len(views) > 1 else "there is one camera; leave out --view")
    left = edit.reduced(Path("scene.sundae")).stated.to(fastest_device())
    if video and edit.speed is None:
        with Console(stderr=True).status("Finding a path"):
            views = film_views(left, seconds=12.0 if seconds is None else seconds, frames_per_second=fps or 24)
    views = views or list(filter(None, [opening(left).start]))
    views = [camera if width is None else camera.zoomed(width / camera.width) for camera in views]
    if video:  # whose colours have half the size
        views = [each._replace(width=each.width // 2 * 2, height=max(each.height // 2, 1) * 2) for each in views]
        speed = fps or edit.speed or 24
        with replacing(out) as partial, progress_bar() as bar:
            images = (image_of(render_view(left, camera).rgb) for camera in bar.track(views, description="Rendering"))
            count = write_video(partial, images, frames_per_second=speed)
        print(f"{out}: {count} frames of {views[0].width} x {views[0].height} px, {count / speed:.1f} s")
        return 0
    write_image(out, image_of(render_view(left, views[view or 0]).rgb))
    print(f"{out}: {views[view or 0].width} x {views[view or 0].height} px")
    return 0
