"""What nerfstudio's viewer asks of a model, on the trained run, without a browser."""

from pathlib import Path

import pytest
import torch
from models import as_the_viewer
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.models.splatfacto import SplatfactoModel
from nerfstudio.utils import colormaps
from nerfstudio.utils.eval_utils import eval_setup
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer_elements import ViewerCheckbox, ViewerElement


@pytest.fixture(scope="module")
def pipeline(tiny):
    return eval_setup(tiny.config, test_mode="inference")[1]


def camera(pipeline, height, aspect):
    """A test camera at another size, as the viewer makes it."""
    known = pipeline.datamanager.eval_dataset.cameras[0:1]
    width = int(height * aspect)
    return Cameras(known.camera_to_worlds, fx=1.2 * height, fy=1.2 * height, cx=width / 2, cy=height / 2).to(
        pipeline.device
    )


@pytest.mark.parametrize(("height", "aspect"), [(30, 1.0), (31, 1.7), (75, 0.6)])
@torch.no_grad()
def test_every_output_becomes_a_picture(pipeline, height, aspect):
    assert isinstance(pipeline.model, SplatfactoModel)
    pipeline.model.set_background(torch.tensor([0.1, 0.2, 0.3], device=pipeline.device))
    outputs = pipeline.model.get_outputs_for_camera(camera(pipeline, height, aspect), obb_box=None)
    assert list(outputs)[0] == "rgb"
    for name, value in outputs.items():
        for normalize in (False, True):
            shown = colormaps.apply_colormap(value, colormaps.ColormapOptions(normalize=normalize))
            assert shown.shape == (height, int(height * aspect), 3), name
            assert torch.isfinite(shown).all(), name
    for name in ("rgb", "base_rgb", "features", "response", "depth"):
        assert outputs[name].std() > 0, name


@torch.no_grad()
def test_check_box_switches_the_head_off(pipeline):
    # As nerfstudio's control panel finds them.
    controls = [control for _, control in parse_object(pipeline.model, ViewerElement, "Custom Elements")]
    (box,) = [control for control in controls if isinstance(control, ViewerCheckbox) and "compensation" in control.name]
    cam = camera(pipeline, 40, 1.0)
    on = pipeline.model.get_outputs_for_camera(cam)
    box.value = False
    off = as_the_viewer(lambda: pipeline.model.get_outputs_for_camera(cam))
    evaluated = pipeline.model.get_outputs_for_camera(cam)
    box.value = True
    assert torch.equal(off["rgb"], off["base_rgb"])
    assert not torch.equal(on["rgb"], on["base_rgb"])
    assert set(on) == set(off)
    # What a viewer shows must not change what the trainer measures.
    assert torch.equal(evaluated["rgb"], on["rgb"])


def listening(port):
    """Addresses at which something listens on a port, as Linux tells them: hexadecimal, 0100007F is 127.0.0.1."""
    found = set()
    for table in ("tcp", "tcp6"):
        path = Path("/proc/net") / table
        for line in path.read_text().splitlines()[1:] if path.exists() else []:
            words = line.split()
            address, _, number = words[1].partition(":")
            if words[3] == "0A" and int(number, 16) == port:
                found.add(address)
    return found


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="looks where Linux lists sockets")
def test_the_viewer_listens_where_the_user_asked_and_nowhere_else(trainer_of):
    def change(config):
        config.vis, config.viewer.websocket_host = "viewer", "127.0.0.1"
        config.get_base_dir().mkdir(parents=True)  # ns-train has written config.yml there by then

    assert ViewerConfig().websocket_host == "0.0.0.0", "README says so"
    server = trainer_of(change).viewer_state.viser_server
    try:
        assert listening(server.get_port()) == {"0100007F"}
    finally:
        server.stop()
